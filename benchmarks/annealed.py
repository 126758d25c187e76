"""The HJI residual under a penalty that hardens while an operator trains, in the set "samplers" of recipes."""

from __future__ import annotations

import copy

from torch import Tensor

from hno.losses import LossTerm, View, hji_residual, losses
from hno.losses.hji import HJIResidual


@losses.register("annealed")
class AnnealedResidual(LossTerm):
    """The HJI residual with one constant of the penalty growing geometrically to the game's own.

    Its scale divides by the game's own penalty throughout.

    Args:
        constant: attribute of the game: "penalty_height" is low at first, "penalty_slope" flat, so that the penalty is
            felt from afar.
        start: share of the constant at first.
        first: step at which it begins to grow.
        last: step from which on it is the game's own.
    """

    stream = "interior"
    scale = HJIResidual.scale

    def __init__(
        self, constant: str = "penalty_height", start: float = 0.05, first: int = 800, last: int = 1400
    ) -> None:
        super().__init__()
        self.constant, self.start, self.first, self.last = constant, start, first, last

    def residual(self, view: View) -> Tensor:
        """(B, P), 1/s."""
        done = (view.step - self.first) / (self.last - self.first)
        share = self.start ** (1 - min(1.0, max(0.0, done)))
        soft = copy.copy(view.game)
        setattr(soft, self.constant, share * getattr(view.game, self.constant))
        return hji_residual(soft, view.sample.points, view.field)
