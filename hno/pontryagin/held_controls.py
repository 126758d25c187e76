"""Optimal control problems over held controls: the joint one that starts the search, and a player's best response.

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

BLOCK = 8192
"""Penalty points that are evaluated together: few enough for the processor's cache."""


class Expansion(NamedTuple):
    """Second-order model of a problem around a trajectory, in deviations of states (D) and controls (M)."""

    state_matrix: Tensor
    """d(next state) / d(state), (R, N, D, D)."""
    control_matrix: Tensor
    """d(next state) / d(control), (R, N, D, M)."""
    gradient: Tensor
    """Of the cost in the states, (R, N + 1, D)."""
    hessian: Tensor
    """Of the cost in the states, positive semidefinite, (R, N + 1, D, D)."""
    control_gradient: Tensor
    """Of the cost in the controls, (R, N, M)."""
    control_hessian: Tensor
    """Of the cost in the controls, (R, N, M, M)."""


class HeldControls:
    """Minimise a cost over controls that are held between time nodes, for a batch of R rows.

    Without `ego` it is the joint cost over the controls of all players. The penalty is then replaced by a convex
    stand-in, which agrees with it where players are safe and keeps pushing where they are not. With `ego` it is that
    player's own cost over its own controls; the others keep theirs.

    Controls are scaled: v in [-1, 1] maps to the control box. The penalty is integrated at several points inside every
    step, so that players who pass each other within one step are seen.

    Args:
        game: the game.
        t: times, s, (N + 1,) or one mesh per row, (R, N + 1).
        theta: player types, (R, P).
        ego: the player whose problem it is, (R,).
        margin: added to the constraint, which keeps players further apart, m for distance constraints.
        points: penalty evaluations inside each step.
    """

    def __init__(
        self,
        game: Game,
        t: Tensor,
        theta: Tensor,
        *,
        ego: Tensor | None = None,
        margin: float = 0.0,
        points: int = 8,
    ) -> None:
        self.game, self.theta, self.ego, self.margin, self.points = game, theta, ego, margin, points
        self.t = t.expand(len(theta), -1)
        self.steps = self.t.shape[-1] - 1
        self.dt = self.t.diff(dim=-1)
        self.share = (torch.arange(points, dtype=theta.dtype, device=theta.device) + 0.5) / points
        players = torch.arange(game.players, device=theta.device)
        self.acts = torch.ones_like(theta) if ego is None else (ego.unsqueeze(-1) == players).to(theta.dtype)

    def rows(self, index: Tensor) -> HeldControls:
        """The same problem for the rows at `index`."""
        ego = None if self.ego is None else self.ego[index]
        t, theta = self.t[index], self.theta[index]
        return HeldControls(self.game, t, theta, ego=ego, margin=self.margin, points=self.points)

    def control(self, v: Tensor) -> Tensor:
        """Physical controls, (..., P, m)."""
        box = self.game.control_box
        return box.lo + (v + 1) / 2 * box.width

    def scaled(self, u: Tensor) -> Tensor:
        """Inverse of `control`."""
        return self.game.control_box.scale(u)

    def advance(self, step: int, x: Tensor, v: Tensor) -> Tensor:
        """States at the end of a step, (R, P, n)."""
        return runge_kutta(self.game, x, self.control(v), self.dt[:, step, None, None])

    def rollout(self, start: Tensor, v: Tensor) -> Tensor:
        """States at every node, (R, P, n), (R, N, P, m) -> (R, N + 1, P, n)."""
        x = [start]
        for k in range(self.steps):
            x.append(self.advance(k, x[-1], v[:, k]))
        return torch.stack(x, 1)

    def cost(self, x: Tensor, v: Tensor) -> Tensor:
        """The cost of each row, (R,)."""
        return torch.cat([part._cost_block(x[index], v[index]) for index, part in self._blocks()])

    def _blocks(self) -> list[tuple[Tensor, HeldControls]]:
        size = max(1, BLOCK // self.steps // self.points)
        blocks = torch.arange(len(self.theta), device=self.theta.device).split(size)
        return [(index, self.rows(index)) for index in blocks]

    def _cost_block(self, x: Tensor, v: Tensor) -> Tensor:
        penalty = self._penalty(self._constraint(self._inside(x)))
        effort = (self.game.effort(self.control(v)) * self.acts.unsqueeze(1)).sum(-1)
        reward = (self.game.terminal_value(x[:, -1]) * self.acts).sum(-1)
        return (self.dt * (effort + penalty.mean(-1))).sum(-1) - reward

    def _inside(self, x: Tensor) -> Tensor:
        """States at the penalty points of each step, on the chords, (R, N + 1, P, n) -> (R, N, Q, P, n)."""
        return torch.lerp(x[:, :-1, None], x[:, 1:, None], self.share[:, None, None])

    def _constraint(self, inside: Tensor) -> Tensor:
        """The constraint that counts, (R, N, Q, P, n) -> (R, N, Q)."""
        each = self.game.constraint(inside, self.theta[:, None, None].expand(inside.shape[:-1]))
        if self.ego is None:
            return each.amax(-1) + self.margin
        return each.gather(-1, self.ego[:, None, None, None].expand(*each.shape[:-1], 1)).squeeze(-1) + self.margin

    def _penalty(self, constraint: Tensor) -> Tensor:
        """The penalty, or its stand-in in the joint problem."""
        if self.ego is not None:
            return self.game.penalty(constraint)
        slope, height = self.game.penalty_slope, self.game.penalty_height
        return height * torch.nn.functional.softplus(slope * constraint)

    def _penalty_slopes(self, constraint: Tensor) -> tuple[Tensor, Tensor]:
        """Its derivative and its curvature, at least 0."""
        with torch.enable_grad():
            point = constraint.detach().requires_grad_()
            push = gradient_of(self._penalty(point).sum(), point, create_graph=True)
            bend = gradient_of(push.sum(), point)
        return push.detach(), bend.clamp_min(0)

    def expand(self, x: Tensor, v: Tensor) -> Expansion:
        """Gauss-Newton expansion around a trajectory, (R, N + 1, P, n), (R, N, P, m)."""
        parts = [part._expand_block(x[index], v[index]) for index, part in self._blocks()]
        return Expansion(*(torch.cat(part) for part in zip(*parts, strict=True)))

    def _expand_block(self, x: Tensor, v: Tensor) -> Expansion:
        gradient, hessian = self._penalty_expansion(x)
        end_gradient, end_hessian = self._end_expansion(x[:, -1])
        gradient[:, -1] += end_gradient
        hessian[:, -1] += end_hessian
        return Expansion(*self._sensitivity(x, v), gradient, hessian, *self._effort_expansion(v))

    def _sensitivity(self, x: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """d(next state) / d(state, control), from the dynamics linearised in the middle of each step."""
        states = x.shape[-1]
        with torch.enable_grad():
            middle = (x[:, 1:] + x[:, :-1]) / 2
            both = torch.cat([middle, v], -1).detach().requires_grad_()
            flow = self.game.dynamics(both[..., :states], self.control(both[..., states:]))
            jacobian = jacobian_rows(flow, both).movedim(0, -2) * self.dt[..., None, None, None]
        inner = torch.eye(states, dtype=x.dtype, device=x.device) + jacobian[..., :states] / 2
        through = inner @ jacobian
        through[..., :states].diagonal(dim1=-2, dim2=-1).add_(1)
        return _block_diagonal(through[..., :states]), _block_diagonal(through[..., states:])

    def _penalty_expansion(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient (R, N + 1, D) and Hessian (R, N + 1, D, D) of the penalty in the states at the nodes.

        A point inside a step moves with both ends; its curvature is shared among them, which bounds it from above.
        """
        with torch.enable_grad():
            inside = self._inside(x).detach().requires_grad_()
            constraint = self._constraint(inside)
            slope = gradient_of(constraint.sum(), inside).flatten(-2)
        push, bend = self._penalty_slopes(constraint)
        weight = self.dt.unsqueeze(-1) / self.points
        push, bend = (weight * push).unsqueeze(-1), (weight * bend).unsqueeze(-1)
        share = self.share.unsqueeze(-1)
        gradient, hessian = x.new_zeros(x.flatten(-2).shape), x.new_zeros(*x.shape[:2], *slope.shape[-1:] * 2)
        for nodes, part in ((slice(None, -1), 1 - share), (slice(1, None), share)):
            gradient[:, nodes] += (part * push * slope).sum(-2)
            hessian[:, nodes] += slope.mT @ (part * bend * slope)
        return gradient, hessian

    def _effort_expansion(self, v: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient (R, N, M) and Hessian (R, N, M, M) of the effort of each step."""
        with torch.enable_grad():
            v = v.detach().requires_grad_()
            total = (self.dt.unsqueeze(-1) * self.game.effort(self.control(v)) * self.acts.unsqueeze(1)).sum()
            slope = gradient_of(total, v, create_graph=True)
            hessian = jacobian_rows(slope, v).movedim(0, -2)
        return slope.detach().flatten(-2), _block_diagonal(hessian)

    def _end_expansion(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient (R, D) and Hessian (R, D, D) of the terminal cost."""
        with torch.enable_grad():
            flat = x.flatten(-2).detach().requires_grad_()
            total = -(self.game.terminal_value(flat.unflatten(-1, x.shape[-2:])) * self.acts).sum()
            slope = gradient_of(total, flat, create_graph=True)
            hessian = jacobian_rows(slope, flat).movedim(0, -2)
        return slope.detach(), hessian


def _block_diagonal(blocks: Tensor) -> Tensor:
    """Players' blocks (..., P, a, b) as one matrix (..., P a, P b)."""
    players, rows, columns = blocks.shape[-3:]
    dense = blocks.new_zeros(*blocks.shape[:-3], players, rows, players, columns)
    dense.diagonal(dim1=-4, dim2=-2).copy_(blocks.movedim(-3, -1))
    return dense.flatten(-4, -3).flatten(-2)
