"""Operators whose HJI term sees a penalty that hardens during the hybrid phase, in the set "samplers" of recipes."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import ClassVar

from torch import Tensor

from hno.games import Game
from hno.losses import LossTerm
from hno.losses.hji import Boundary, HJIResidual, hji_residual
from hno.losses.supervised import CostateDeviation, ValueDeviation
from hno.operators import ValueOperator, operators
from hno.types import Batch, Field, Sample

FIRST, LAST = 800, 1400
"""Steps between which the penalty hardens: the first half of the hybrid phase of its recipes."""
START = 0.05
"""Share of the game's penalty at first."""


class _Annealed(LossTerm):
    """The HJI residual with one constant of the penalty growing geometrically to the game's.

    Its scale divides by the game's own penalty throughout.
    """

    stream = "interior"
    constant: ClassVar[str]
    """Attribute of the game."""
    scale = HJIResidual.scale
    step: int = LAST

    def residual(self, game: Game, sample: Sample, field: Field) -> Tensor:
        """(B, P), 1/s."""
        done = (self.step - FIRST) / (LAST - FIRST)
        share = START ** (1 - min(1.0, max(0.0, done)))
        soft = copy.copy(game)
        setattr(soft, self.constant, share * getattr(game, self.constant))
        return hji_residual(soft, sample.points, field)


class AnnealedHeight(_Annealed):
    """Low at first."""

    constant = "penalty_height"


class AnnealedSlope(_Annealed):
    """Flat at first, so that it is felt from afar."""

    constant = "penalty_slope"


class _AnnealedOperator(ValueOperator):
    """HNO that tells its residual the step."""

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """As of any operator."""
        term = self.term("residual")
        assert isinstance(term, _Annealed)
        term.step = self.global_step
        return super().training_step(batch, batch_idx)


@operators.register("hno_annealed_height")
class AnnealedHeightOperator(_AnnealedOperator):
    """HNO with `AnnealedHeight`."""

    terms: ClassVar[Mapping[str, type[LossTerm]]] = {
        "value": ValueDeviation,
        "costate": CostateDeviation,
        "boundary": Boundary,
        "residual": AnnealedHeight,
    }


@operators.register("hno_annealed_slope")
class AnnealedSlopeOperator(_AnnealedOperator):
    """HNO with `AnnealedSlope`."""

    terms: ClassVar[Mapping[str, type[LossTerm]]] = {
        "value": ValueDeviation,
        "costate": CostateDeviation,
        "boundary": Boundary,
        "residual": AnnealedSlope,
    }
