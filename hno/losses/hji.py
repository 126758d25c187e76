"""Terms of the Hamilton-Jacobi-Isaacs equation and its boundary condition (paper, eq. 3 and 6)."""

from __future__ import annotations

from typing import final

from torch import Tensor

from hno.games.potential import Problem
from hno.losses.base import LossTerm, View, losses
from hno.types import Field, Points, PotentialField


def hji_residual(problem: Problem, points: Points, field: Field | PotentialField) -> Tensor:
    """HJI residual dV/dtau - max_u H of every player (B, P), or of the potential (B, 1).

    Zero for an exact equilibrium value (paper, eq. 3, in time to go).
    """
    u = problem.optimal_control(points.x, field.costate)
    return field.dvalue_dtau - problem.hamiltonian(points.x, field.costate, u, points.theta)


@final
@losses.register("residual")
class HJIResidual(LossTerm):
    """The HJI residual at collocation points inside the time window."""

    stream = "interior"

    def residual(self, view: View) -> Tensor:
        """(B, Q), 1/s."""
        return hji_residual(view.problem, view.sample.points, view.field)

    def scale(self, view: View) -> Tensor:
        """Size of values per horizon, plus the cost of the state at each point, (B, Q).

        Without it, points deep inside the violation set, where it is thousands of times larger and where no
        equilibrium goes, would make up the whole loss.
        """
        points = view.sample.points
        cost = view.problem.uncontrolled_cost(points.x, points.theta)
        return view.scales.value / view.game.horizon + cost.abs()


@final
@losses.register("boundary")
class Boundary(LossTerm):
    """Terminal condition V(0, x) = -g(x) in reward form."""

    stream = "terminal"
    met_by_exact_terminal = True

    def residual(self, view: View) -> Tensor:
        """(B, Q)."""
        return view.field.value - view.problem.terminal_value(view.sample.points.x)

    def scale(self, view: View) -> Tensor:
        """Size of values."""
        return view.scales.value
