"""Labels: open-loop equilibria of any game by Pontryagin's principle."""

from hno.pontryagin.solve import Solver, solve

__all__ = ["Solver", "solve"]
