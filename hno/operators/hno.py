"""The Hybrid Neural Operator (paper, eq. 6)."""

from __future__ import annotations

from typing import final

from hno.losses.hji import Boundary, HJIResidual
from hno.losses.supervised import CostateDeviation, ValueDeviation
from hno.operators.base import ValueOperator, operators


@final
@operators.register("hno")
class HybridNeuralOperator(ValueOperator):
    """Supervised by labels and by the HJI equation with its boundary condition."""

    terms = {"value": ValueDeviation, "costate": CostateDeviation, "boundary": Boundary, "residual": HJIResidual}
