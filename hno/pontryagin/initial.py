"""Starting trajectories by descent on the joint cost, from several topologies.

When the players' constraints are one function, their penalty is shared: a stationary point of the joint cost (efforts,
terminal costs and the penalty once) is then an open-loop equilibrium. In any other game it is a good start.

The descent is a Gauss-Newton version of differential dynamic programming, with controls clamped to their box. The
penalty is integrated at several points inside every step, so that cars that pass each other within one step are seen.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import torch
from torch import Tensor

from hno.games import Game
from hno.pontryagin.adjoint import jacobian_rows


class Descent(NamedTuple):
    """Settings of the descent."""

    margins: tuple[float, ...] = (0.6, 0.0)
    """Constraint tightening of each phase, m for distance constraints."""
    iterations: int = 25
    """Iterations per phase."""
    points: int = 8
    """Penalty evaluations inside each step."""
    tolerance: float = 1e-4
    """Relative decrease below which a trajectory is left alone."""


class Quadratic(NamedTuple):
    """Expansion of the joint cost in the deviations (dx, dv) of every step."""

    gradient: Tensor
    """(R, N, D + M)."""
    hessian: Tensor
    """(R, N, D + M, D + M)."""


class JointProblem:
    """The joint optimal control problem of all players, on a uniform grid of held controls.

    Controls are scaled: v in [-1, 1] maps to the control box.

    Args:
        game: the game, float64.
        theta: player types, (R, P).
        margin: added to the constraint, which keeps the players further apart.
        points: penalty evaluations inside each step.
    """

    def __init__(self, game: Game, theta: Tensor, margin: float, points: int) -> None:
        self.game, self.theta, self.margin = game, theta, margin
        self.steps = round(game.horizon / game.label_step)
        self.dt = game.horizon / self.steps
        centres = (torch.arange(points, dtype=theta.dtype, device=theta.device) + 0.5) / points
        self.share = centres.view(-1, 1, 1)

    def rows(self, index: Tensor) -> JointProblem:
        """The same problem for some of the rows."""
        part = object.__new__(JointProblem)
        part.__dict__.update(self.__dict__, theta=self.theta[index])
        return part

    def control(self, v: Tensor) -> Tensor:
        """Physical controls, (..., P, m)."""
        box = self.game.control_box
        return box.lo + (v + 1) / 2 * box.width

    def advance(self, x: Tensor, v: Tensor) -> Tensor:
        """One Runge-Kutta step at held control, (..., P, n)."""
        return runge_kutta(self.game, x, self.control(v), self.dt)

    def soft_penalty(self, constraint: Tensor) -> Tensor:
        """Convex stand-in for the penalty: it agrees where players are safe and keeps pushing where they are not."""
        worst = constraint.amax(-1) + self.margin
        return self.game.penalty_height * torch.nn.functional.softplus(self.game.penalty_slope * worst)

    def between(self, x: Tensor) -> Tensor:
        """States at the penalty points of each step, (R, N + 1, P, n) -> (R, N, Q, P, n)."""
        start, end = x[:, :-1, None], x[:, 1:, None]
        return torch.lerp(start, end, self.share.expand(*start.shape[:2], -1, *start.shape[-2:]))

    def types(self, x: Tensor) -> Tensor:
        """Types broadcast over the inner axes of x (R, ..., P, n), (R, ..., P)."""
        return self.theta.view(len(self.theta), *(1,) * (x.dim() - 3), -1).expand(x.shape[:-1])

    def cost(self, x: Tensor, v: Tensor) -> Tensor:
        """Joint cost with the stand-in penalty, (R,)."""
        inner = self.between(x)
        penalty = self.soft_penalty(self.game.constraint(inner, self.types(inner))).mean(-1).sum(-1)
        effort = self.game.effort(self.control(v)).sum((-2, -1))
        return self.dt * (effort + penalty) - self.game.terminal_value(x[:, -1]).sum(-1)
