"""Extensions of hno from outside: games, a network, a loss term, a source of points, and two ways to use them."""
