"""From an operator, loss terms and data to a trained operator."""

from hno.training.fit import Fitted, Settings, fit

__all__ = ["Fitted", "Settings", "fit"]
