"""Controllers, and the simulation that plays them."""
