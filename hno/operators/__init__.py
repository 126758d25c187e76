"""Value operators: networks that map player types to value functions."""

from hno.operators.activations import Activation, activations
from hno.operators.base import ValueOperator, functions
from hno.operators.build import Architecture, Choice, make_operator
from hno.operators.network import Inputs, Network, networks

__all__ = [
    "Activation", "Architecture", "Choice", "Inputs", "Network", "ValueOperator", "activations", "functions",
    "make_operator", "networks",
]  # fmt: skip
