"""Labels: open-loop equilibria of any game by Pontryagin's principle."""

from hno.pontryagin.online import subgame
from hno.pontryagin.solve import Solver, solve

__all__ = ["Solver", "solve", "subgame"]
