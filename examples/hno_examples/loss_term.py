"""A loss term of one's own: the residual of the Hamilton-Jacobi-Isaacs equation, which grows in as training goes on.

`examples/recipe/conf/operator/growing.yaml` makes a method of it, with labels beside it.
"""

from __future__ import annotations

from typing import final

from torch import Tensor

from hno.losses import LossTerm, View, hji_residual


@final
class GrowingResidual(LossTerm):
    """min(1, (step + 1) / steps) times the residual of the equation.

    Args:
        steps: training steps until it counts in full.

    Raises:
        ValueError: `steps` is no positive whole number.
    """

    stream = "interior"

    def __init__(self, steps: int = 1000) -> None:
        super().__init__()
        if not (isinstance(steps, int) and steps > 0):
            raise ValueError(f"loss.terms.growing_residual.steps must be a positive whole number; got {steps!r}.")
        self.steps = steps

    def residual(self, view: View) -> Tensor:
        """(B, P), or (B, 1) of a potential, 1/s."""
        share = min(1.0, (view.step + 1) / self.steps)
        return share * hji_residual(view.problem, view.sample.points, view.field)

    def scale(self, view: View) -> Tensor:
        """Size of values per horizon, and the cost of the state where that is larger, as `residual`."""
        points = view.sample.points
        cost = view.problem.uncontrolled_cost(points.x, points.theta).abs()
        return cost.maximum(view.scales.value / view.game.horizon)
