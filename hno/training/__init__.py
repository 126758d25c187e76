"""From an operator, loss terms and data to a trained operator."""

from hno.training.fit import Fitted, fit
from hno.training.settings import Settings

__all__ = ["Fitted", "Settings", "fit"]
