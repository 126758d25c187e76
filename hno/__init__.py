"""Parametric value functions of general-sum differential games, and the feedback controllers they give."""

from hno import games
from hno.pontryagin.solve import solve
from hno.training.checkpoint import load_policy

__version__ = "0.1.0"
__all__ = ["__version__", "games", "load_policy", "solve"]
