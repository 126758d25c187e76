"""Value operators: networks that map player types to value functions."""

from hno.operators.activations import activations
from hno.operators.base import ValueOperator, operators

__all__ = ["ValueOperator", "activations", "operators"]
