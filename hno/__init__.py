"""Parametric value functions of general-sum differential games, and the feedback controllers they give."""

from hno import games
from hno.operators.checkpoint import load_policy
from hno.pontryagin.solve import solve

__version__ = "0.1.0"
__all__ = ["__version__", "games", "load_policy", "solve"]
