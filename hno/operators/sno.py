"""The Supervised Neural Operator, the paper's baseline."""

from __future__ import annotations

from typing import final

from hno.losses.supervised import CostateDeviation, ValueDeviation
from hno.operators.base import ValueOperator, operators


@final
@operators.register("sno")
class SupervisedNeuralOperator(ValueOperator):
    """Supervised by labels alone."""

    terms = {"value": ValueDeviation, "costate": CostateDeviation}
