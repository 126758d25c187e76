"""The Hybrid Neural Operator (paper, eq. 6)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, final

from hno.losses.base import LossTerm
from hno.losses.hji import Boundary, HJIResidual
from hno.losses.supervised import CostateDeviation, ValueDeviation
from hno.operators.base import ValueOperator, operators


@final
@operators.register("hno")
class HybridNeuralOperator(ValueOperator):
    """Supervised by labels and by the HJI equation with its boundary condition."""

    terms: ClassVar[Mapping[str, type[LossTerm]]] = {
        "value": ValueDeviation,
        "costate": CostateDeviation,
        "boundary": Boundary,
        "residual": HJIResidual,
    }
