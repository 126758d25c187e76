"""Terms that compare with Pontryagin labels (paper, eq. 6, third and fourth sums)."""

from __future__ import annotations

from typing import final

from torch import Tensor

from hno.losses.base import LossTerm, View, losses
from hno.types import Labels


def _labels(view: View) -> Labels:
    if view.sample.labels is None:
        raise ValueError("A supervised term needs the labelled stream 'bvp'; this sample has points only.")
    return view.sample.labels


@final
@losses.register("value")
class ValueDeviation(LossTerm):
    """Predicted minus labelled value."""

    stream = "bvp"

    def residual(self, view: View) -> Tensor:
        """(B, P)."""
        return view.field.value - _labels(view).value

    def scale(self, view: View) -> Tensor:
        """Size of values."""
        return view.scales.value


@final
@losses.register("costate")
class CostateDeviation(LossTerm):
    """Predicted minus labelled costate."""

    stream = "bvp"

    def residual(self, view: View) -> Tensor:
        """(B, P, P, n)."""
        return view.field.costate - _labels(view).costate

    def scale(self, view: View) -> Tensor:
        """Size of each costate component."""
        return view.scales.costate
