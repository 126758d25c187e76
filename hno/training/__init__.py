"""From an operator, loss terms and data to a trained operator."""
