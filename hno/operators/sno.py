"""The Supervised Neural Operator, the paper's baseline."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, final

from hno.losses.base import LossTerm
from hno.losses.supervised import CostateDeviation, ValueDeviation
from hno.operators.base import ValueOperator, operators


@final
@operators.register("sno")
class SupervisedNeuralOperator(ValueOperator):
    """Supervised by labels alone."""

    terms: ClassVar[Mapping[str, type[LossTerm]]] = {"value": ValueDeviation, "costate": CostateDeviation}
