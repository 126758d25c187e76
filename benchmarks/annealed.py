"""Operators whose HJI term sees a penalty that hardens during the hybrid phase, for the set "annealed" of recipes."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from hno.games import Game
from hno.losses import LossTerm
from hno.losses.hji import Boundary, HJIResidual, hji_residual
from hno.losses.supervised import CostateDeviation, ValueDeviation
from hno.operators import ValueOperator, operators
from hno.types import Field, Sample

STEPS = 600
"""Training steps with collocation points until the penalty is the game's: half of those of the default recipe."""
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
    step: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("step", torch.tensor(0))

    def residual(self, game: Game, sample: Sample, field: Field) -> Tensor:
        """(B, P), 1/s."""
        share = START ** (1 - min(1.0, float(self.step) / STEPS))
        soft = copy.copy(game)
        setattr(soft, self.constant, share * getattr(game, self.constant))
        self.step += int(self.training)
        return hji_residual(soft, sample.points, field)


class AnnealedHeight(_Annealed):
    """Low at first."""

    constant = "penalty_height"


class AnnealedSlope(_Annealed):
    """Flat at first, so that it is felt from afar."""

    constant = "penalty_slope"


@operators.register("hno_annealed_height")
class AnnealedHeightOperator(ValueOperator):
    """HNO with `AnnealedHeight`."""

    terms: ClassVar[Mapping[str, type[LossTerm]]] = {
        "value": ValueDeviation,
        "costate": CostateDeviation,
        "boundary": Boundary,
        "residual": AnnealedHeight,
    }


@operators.register("hno_annealed_slope")
class AnnealedSlopeOperator(ValueOperator):
    """HNO with `AnnealedSlope`."""

    terms: ClassVar[Mapping[str, type[LossTerm]]] = {
        "value": ValueDeviation,
        "costate": CostateDeviation,
        "boundary": Boundary,
        "residual": AnnealedSlope,
    }
