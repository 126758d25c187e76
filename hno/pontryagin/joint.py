"""The joint optimal control problem whose minimisers start the search for equilibria.

When the players' constraints are one function, their penalty is shared: a stationary point of the joint cost (efforts,
terminal costs and the penalty once) is then an open-loop equilibrium. In any other game it is a good start.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from hno.games import Game
from hno.pontryagin.adjoint import gradient_of, jacobian_rows
from hno.pontryagin.integrate import runge_kutta

BLOCK = 64
"""Rows that are expanded together: few enough for the processor's cache."""


class Expansion(NamedTuple):
    """Second-order model of the joint problem around a trajectory, in deviations of states (D) and controls (M)."""

    dynamics: Tensor
    """d(next state) = dynamics (dx, dv), (R, N, D, D + M)."""
    gradient: Tensor
    """Of the step cost, (R, N, D + M)."""
    hessian: Tensor
    """Of the step cost, positive semidefinite, (R, N, D + M, D + M)."""
    end_gradient: Tensor
    """Of the terminal cost, (R, D)."""
    end_hessian: Tensor
    """Of the terminal cost, (R, D, D)."""


class JointProblem:
    """Minimise the joint cost over held controls on the label grid, for a batch of R rows.

    Controls are scaled: v in [-1, 1] maps to the control box. The penalty is integrated at several points inside every
    step, so that players who pass each other within one step are seen, and replaced by a convex stand-in, which agrees
    with it where players are safe and keeps pushing where they are not.

    Args:
        game: the game, float64.
        theta: player types, (R, P).
        margin: added to the constraint, which keeps players further apart, m for distance constraints.
        points: penalty evaluations inside each step.
    """

    def __init__(self, game: Game, theta: Tensor, margin: float = 0.0, points: int = 8) -> None:
        self.game, self.theta, self.margin, self.points = game, theta, margin, points
        self.steps = round(game.horizon / game.label_step)
        self.dt = game.horizon / self.steps
        self.share = (torch.arange(points, dtype=theta.dtype, device=theta.device) + 0.5) / points

    def rows(self, index: Tensor) -> JointProblem:
        """The same problem for the rows at `index`."""
        return JointProblem(self.game, self.theta[index], self.margin, self.points)

    def control(self, v: Tensor) -> Tensor:
        """Physical controls, (..., P, m)."""
        box = self.game.control_box
        return box.lo + (v + 1) / 2 * box.width

    def scaled(self, u: Tensor) -> Tensor:
        """Inverse of `control`."""
        return self.game.control_box.scale(u)

    def advance(self, x: Tensor, v: Tensor) -> Tensor:
        """States after one step, (..., P, n)."""
        return runge_kutta(self.game, x, self.control(v), self.dt)

    def rollout(self, start: Tensor, v: Tensor) -> Tensor:
        """States at every node, (R, P, n), (R, N, P, m) -> (R, N + 1, P, n)."""
        x = [start]
        for k in range(self.steps):
            x.append(self.advance(x[-1], v[:, k]))
        return torch.stack(x, 1)

    def worst_constraint(self, x: Tensor) -> Tensor:
        """Largest constraint at the penalty points of each step, (R, N + 1, P, n) -> (R, N, Q)."""
        inner = torch.lerp(x[:, :-1, None], x[:, 1:, None], self.share[:, None, None].to(x))
        theta = self.theta[:, None, None].expand(inner.shape[:-1])
        return self.game.constraint(inner, theta).amax(-1) + self.margin

    def cost(self, x: Tensor, v: Tensor) -> Tensor:
        """Joint cost with the stand-in penalty, (R,)."""
        rows = torch.arange(len(x), device=x.device).split(BLOCK)
        return torch.cat([self.rows(index)._cost_block(x[index], v[index]) for index in rows])

    def _cost_block(self, x: Tensor, v: Tensor) -> Tensor:
        slope, height = self.game.penalty_slope, self.game.penalty_height
        penalty = height * torch.nn.functional.softplus(slope * self.worst_constraint(x))
        effort = self.game.effort(self.control(v)).sum((-2, -1))
        return self.dt * (effort + penalty.mean(-1).sum(-1)) - self.game.terminal_value(x[:, -1]).sum(-1)

    def expand(self, x: Tensor, v: Tensor) -> Expansion:
        """Gauss-Newton expansion around a trajectory, (R, N + 1, P, n), (R, N, P, m)."""
        rows = torch.arange(len(x), device=x.device).split(BLOCK)
        parts = [self.rows(index)._expand_block(x[index], v[index]) for index in rows]
        return Expansion(*(torch.cat(part) for part in zip(*parts, strict=True)))

    def _expand_block(self, x: Tensor, v: Tensor) -> Expansion:
        sensitivity = self._sensitivity(x[:, :-1], v)
        gradient, hessian = self._penalty_expansion(x, sensitivity)
        effort_gradient, effort_hessian = self._effort_expansion(v)
        states = x.shape[-2] * x.shape[-1]
        gradient[..., states:] += effort_gradient
        hessian[..., states:, states:] += effort_hessian
        dynamics = torch.cat([_block_diagonal(part) for part in sensitivity.split([x.shape[-1], v.shape[-1]], -1)], -1)
        return Expansion(dynamics, gradient, hessian, *self._end_expansion(x[:, -1]))

    def _sensitivity(self, x: Tensor, v: Tensor) -> Tensor:
        """d(next state of i) / d(state and control of i), (R, N, P, n, n + m)."""
        with torch.enable_grad():
            both = torch.cat([x, v], -1).detach().requires_grad_()
            after = self.advance(*both.split([x.shape[-1], v.shape[-1]], -1))
            return jacobian_rows(after, both).movedim(0, -2)

    def _penalty_expansion(self, x: Tensor, sensitivity: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient and Gauss-Newton Hessian of the penalty of each step in (dx, dv)."""
        start, end, share = x[:, :-1, None], x[:, 1:, None], self.share[:, None, None]
        with torch.enable_grad():
            inner = torch.lerp(start, end, share.to(x)).detach().requires_grad_()
            theta = self.theta[:, None, None].expand(inner.shape[:-1])
            worst = self.game.constraint(inner, theta).amax(-1) + self.margin
            slope = gradient_of(worst.sum(), inner)
        through = torch.einsum("rkqpn,rkpnj->rkqpj", slope, sensitivity) * share
        at_start, at_control = through.split([x.shape[-1], sensitivity.shape[-1] - x.shape[-1]], -1)
        row = torch.cat([((1 - share) * slope + at_start).flatten(-2), at_control.flatten(-2)], -1)
        steep, height = self.game.penalty_slope, self.game.penalty_height * self.dt / self.points
        active = torch.sigmoid(steep * worst.detach())
        gradient = (height * steep * active).unsqueeze(-2) @ row
        curved = (height * steep**2 * active * (1 - active)).unsqueeze(-1) * row
        return gradient.squeeze(-2), row.mT @ curved

    def _effort_expansion(self, v: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient (R, N, M) and Hessian (R, N, M, M) of the effort of each step."""
        with torch.enable_grad():
            v = v.detach().requires_grad_()
            total = self.dt * self.game.effort(self.control(v)).sum()
            slope = gradient_of(total, v, create_graph=True)
            hessian = jacobian_rows(slope, v).movedim(0, -2)
        return slope.detach().flatten(-2), _block_diagonal(hessian)

    def _end_expansion(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient (R, D) and Hessian (R, D, D) of the terminal cost."""
        with torch.enable_grad():
            flat = x.flatten(-2).detach().requires_grad_()
            total = -self.game.terminal_value(flat.unflatten(-1, x.shape[-2:])).sum()
            slope = gradient_of(total, flat, create_graph=True)
            hessian = jacobian_rows(slope, flat).movedim(0, -2)
        return slope.detach(), hessian


def _block_diagonal(blocks: Tensor) -> Tensor:
    """Players' blocks (..., P, a, b) as one matrix (..., P a, P b)."""
    players = torch.eye(blocks.shape[-3], dtype=blocks.dtype, device=blocks.device)
    return torch.einsum("...pab,pq->...paqb", blocks, players).flatten(-4, -3).flatten(-2)
