"""A loss term: all four arms of the crossing are alike."""

from __future__ import annotations

from typing import final

from torch import Tensor

from hno.losses import LossTerm, View
from hno.types import Points


@final
class Turned(LossTerm):
    """Values after a quarter turn of all cars and types minus those before it."""

    stream = "interior"

    def residual(self, view: View) -> Tensor:
        """(B, 4), or (B, 1) of a potential."""
        tau, x, theta = view.sample.points
        turned = view.at(Points(tau, x.roll(1, 1), theta.roll(1, 1)))
        return turned.value - view.field.value.roll(1, -1)

    def scale(self, view: View) -> Tensor:
        """Size of values."""
        return view.scales.value
