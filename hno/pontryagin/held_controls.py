"""Optimal control problems over held controls: the joint one that starts the search, and a player's best response.

The joint cost is the sum of efforts, state costs and terminal costs, and the penalty of every distinct constraint once.
Where players share all that couples them, as those who keep distance pairwise do, a stationary point of it is an
open-loop equilibrium. In any other game it is a start.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hno.games import Game
from hno.pontryagin.adjoint import gradient_of, jacobian_rows
from hno.pontryagin.expansion import Expansion, block_diagonal, positive_part
from hno.pontryagin.integrate import runge_kutta

BLOCK = 8192
"""Penalty points that are evaluated together: few enough for the processor's cache."""


class HeldControls:
    """Minimise a cost over controls that are held between time nodes, for a batch of R rows.

    Without `ego` it is the joint cost over the controls of all players. The penalties are then replaced by convex
    stand-ins, which agree with them where players are safe and keep pushing where they are not. With `ego` it is that
    player's own cost over its own controls; the others keep theirs.

    Controls are scaled: v in [-1, 1] maps to the control box. Costs of states are integrated at several points inside
    every step, so that players who pass each other within one step are seen.

    Args:
        game: the game.
        t: times, s, (N + 1,) or one mesh per row, (R, N + 1).
        theta: player types, (R, P).
        ego: the player whose problem it is, (R,).
        margin: added to the constraints of the joint problem, which keeps players further apart, m for distances.
        points: evaluations of costs of states inside each step.
        distinct: what `distinct_constraints` finds, if it is known already.
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
        distinct: Tensor | None = None,
    ) -> None:
        self.game, self.theta, self.ego, self.margin, self.points = game, theta, ego, margin, points
        self.t = t.expand(len(theta), -1)
        self.steps = self.t.shape[-1] - 1
        self.dt = self.t.diff(dim=-1)
        self.share = (torch.arange(points, dtype=theta.dtype, device=theta.device) + 0.5) / points
        players = torch.arange(game.players, device=theta.device)
        self.distinct = distinct_constraints(game) if distinct is None else distinct
        self.own_penalty = ego is not None and game.overrides("penalty")
        self.smooth = self.own_penalty or game.overrides("state_cost")
        self.acts = torch.ones_like(theta) if ego is None else (ego.unsqueeze(-1) == players).to(theta.dtype)

    def rows(self, index: Tensor) -> HeldControls:
        """The same problem for the rows at `index`."""
        ego = None if self.ego is None else self.ego[index]
        t, theta = self.t[index], self.theta[index]
        margin, points, distinct = self.margin, self.points, self.distinct
        return HeldControls(self.game, t, theta, ego=ego, margin=margin, points=points, distinct=distinct)

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
        inside = self._inside(x)
        spent = self._penalty(self._constraints(inside)).sum(-1) + self._smooth_cost(inside)
        effort = (self.game.effort(self.control(v)) * self.acts.unsqueeze(1)).sum(-1)
        reward = (self.game.terminal_value(x[:, -1]) * self.acts).sum(-1)
        return (self.dt * (effort + spent.mean(-1))).sum(-1) - reward

    def _inside(self, x: Tensor) -> Tensor:
        """States at several points of each step, on the chords, (R, N + 1, P, n) -> (R, N, Q, P, n)."""
        return torch.lerp(x[:, :-1, None], x[:, 1:, None], self.share[:, None, None])

    def _constraints(self, inside: Tensor) -> Tensor:
        """The constraints whose soft constraints count, (R, N, Q, P, n) -> (R, N, Q, C)."""
        each = self.game.constraint(inside, self._types(inside))
        if self.ego is None:
            return each.flatten(-2).index_select(-1, self.distinct) + self.margin
        ego = self.ego.view(-1, 1, 1, 1, 1).expand(*each.shape[:-2], 1, 0 if self.own_penalty else each.shape[-1])
        return each.gather(-2, ego).squeeze(-2)

    def _smooth_cost(self, inside: Tensor) -> Tensor:
        """Costs of states that are no soft constraints, (R, N, Q, P, n) -> (R, N, Q)."""
        if not self.smooth:
            return inside.new_zeros(())
        cost = self.game.state_cost(inside, self._types(inside))
        if self.own_penalty:
            cost = cost + self.game.penalty(inside, self._types(inside))
        return (cost * self.acts[:, None, None]).sum(-1)

    def _types(self, inside: Tensor) -> Tensor:
        return self.theta[:, None, None].expand(inside.shape[:-1])

    def _penalty(self, constraint: Tensor) -> Tensor:
        """Soft constraints, or their stand-ins in the joint problem."""
        if self.ego is not None:
            return self.game.soft_constraint(constraint)
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
        gradient, hessian = self._state_expansion(x)
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
        return block_diagonal(through[..., :states]), block_diagonal(through[..., states:])

    def _state_expansion(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient (R, N + 1, D) and Hessian (R, N + 1, D, D) of costs of states in the states at the nodes.

        A point inside a step moves with both ends; its curvature is shared among them, which bounds it from above.
        """
        gradient, hessian = x.new_zeros(x.flatten(-2).shape), x.new_zeros(*x.shape[:2], *[x[0, 0].numel()] * 2)
        with torch.enable_grad():
            inside = self._inside(x).detach().requires_grad_()
            constraints = self._constraints(inside)
            slopes = [gradient_of(column.sum(), inside).flatten(-2) for column in constraints.unbind(-1)]
        weight = self.dt.unsqueeze(-1) / self.points
        for slope, constraint in zip(slopes, constraints.unbind(-1), strict=True):
            push, bend = ((weight * part).unsqueeze(-1) for part in self._penalty_slopes(constraint))
            for nodes, share in self._ends():
                gradient[:, nodes] += (share * push * slope).sum(-2)
                hessian[:, nodes] += slope.mT @ (share * bend * slope)
        if self.smooth:
            slope, curvature = self._smooth_expansion(inside)
            for nodes, share in self._ends():
                gradient[:, nodes] += (share * weight.unsqueeze(-1) * slope).sum(-2)
                hessian[:, nodes] += ((share * weight.unsqueeze(-1)).unsqueeze(-1) * curvature).sum(-3)
        return gradient, hessian

    def _ends(self) -> tuple[tuple[slice, Tensor], tuple[slice, Tensor]]:
        """Nodes before and after the steps, and the share (Q, 1) that each has in the points inside."""
        share = self.share.unsqueeze(-1)
        return (slice(None, -1), 1 - share), (slice(1, None), share)

    def _smooth_expansion(self, inside: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient (R, N, Q, D) of `_smooth_cost` and the positive part of its Hessian (R, N, Q, D, D)."""
        with torch.enable_grad():
            flat = inside.detach().flatten(-2).requires_grad_()
            cost = self._smooth_cost(flat.unflatten(-1, inside.shape[-2:]))
            slope = gradient_of(cost.sum(), flat, create_graph=True)
            hessian = jacobian_rows(slope, flat).movedim(0, -2)
        return slope.detach(), positive_part(hessian)

    def _effort_expansion(self, v: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient (R, N, M) and Hessian (R, N, M, M) of the effort of each step."""
        with torch.enable_grad():
            v = v.detach().requires_grad_()
            total = (self.dt.unsqueeze(-1) * self.game.effort(self.control(v)) * self.acts.unsqueeze(1)).sum()
            slope = gradient_of(total, v, create_graph=True)
            hessian = jacobian_rows(slope, v).movedim(0, -2)
        return slope.detach().flatten(-2), block_diagonal(hessian)

    def _end_expansion(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient (R, D) and Hessian (R, D, D) of the terminal cost."""
        with torch.enable_grad():
            flat = x.flatten(-2).detach().requires_grad_()
            total = -(self.game.terminal_value(flat.unflatten(-1, x.shape[-2:])) * self.acts).sum()
            slope = gradient_of(total, flat, create_graph=True)
            hessian = jacobian_rows(slope, flat).movedim(0, -2)
        return slope.detach(), hessian


def distinct_constraints(game: Game) -> Tensor:
    """Which constraints are different functions, as places in (P, C) flattened, found at random points, (D,)."""
    generator = torch.Generator().manual_seed(0)
    x, theta = game.state_box.sample(256, generator), game.type_box.sample(256, generator)
    values = game.constraint(x, theta).flatten(-2)
    apart = (values.unsqueeze(-1) - values.unsqueeze(-2)).abs().amax(0)
    first = (apart <= 1e-5 * values.abs().amax()).int().argmax(-1)
    places = torch.arange(len(first), device=first.device)
    return places[first == places]
