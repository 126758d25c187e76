"""Terms that compare with Pontryagin labels (paper, eq. 6, third and fourth sums)."""

from __future__ import annotations

from typing import final

from torch import Tensor

from hno.games import Game
from hno.losses.base import LossTerm, Scales, losses
from hno.types import Field, Labels, Sample


def _labels(sample: Sample) -> Labels:
    if sample.labels is None:
        raise ValueError("A supervised term needs the labelled stream 'bvp'; this sample has points only.")
    return sample.labels


@final
@losses.register("value")
class ValueDeviation(LossTerm):
    """Predicted minus labelled value, (B, P)."""

    stream = "bvp"

    def residual(self, game: Game, sample: Sample, field: Field) -> Tensor:
        """(B, P)."""
        return field.value - _labels(sample).value

    def scale(self, game: Game, sample: Sample, scales: Scales) -> Tensor:
        """Size of values."""
        return scales.value


@final
@losses.register("costate")
class CostateDeviation(LossTerm):
    """Predicted minus labelled costate, (B, P, P, n)."""

    stream = "bvp"

    def residual(self, game: Game, sample: Sample, field: Field) -> Tensor:
        """(B, P, P, n)."""
        return field.costate - _labels(sample).costate

    def scale(self, game: Game, sample: Sample, scales: Scales) -> Tensor:
        """Size of each costate component."""
        return scales.costate
