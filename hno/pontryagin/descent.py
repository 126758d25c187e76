"""Batched differential dynamic programming over held controls that are clamped to their box."""

from __future__ import annotations

import torch
from torch import Tensor

from hno.pontryagin.expansion import Expansion
from hno.pontryagin.held_controls import HeldControls

STEP_LENGTHS = (1.0, 0.5, 0.2, 0.05)
"""Step lengths in the order in which they are tried."""


def descend(
    problem: HeldControls, start: Tensor, v: Tensor, iterations: int, tolerance: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Lower the cost of every row.

    Args:
        problem: a problem of R rows.
        start: initial states, (R, P, n).
        v: scaled controls to start from, (R, N, P, m).
        iterations: iteration budget.
        tolerance: relative decrease below which a row is left alone.

    Returns:
        States (R, N + 1, P, n), scaled controls (R, N, P, m) and costs (R,).
    """
    v = v.clone()
    x = problem.rollout(start, v)
    cost = problem.cost(x, v)
    damping = torch.full_like(cost, 1e-2)
    active = torch.arange(len(cost), device=cost.device)
    for _ in range(iterations):
        part = problem.rows(active)
        policy = _backward(part, part.expand(x[active], v[active]), v[active], damping[active])
        moved_x, moved_v, reached = _forward(part, x[active], v[active], cost[active], policy)
        gain = cost[active] - reached
        better = gain > 0
        x[active], v[active], cost[active] = moved_x, moved_v, reached
        damping[active] *= torch.where(better, 0.3, 10.0)
        going = torch.where(better, gain > tolerance * cost[active].abs(), damping[active] < 1e6)
        active = active[going]
        if len(active) == 0:
            break
    return x, v, cost


def _backward(problem: HeldControls, model: Expansion, v: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
    """Open-loop steps (R, N, M) and feedback gains (R, N, M, D) that minimise the model."""
    slope, curve = model.gradient[:, -1], model.hessian[:, -1]
    states, controls = model.control_matrix.shape[-2:]
    eye = torch.eye(controls, dtype=v.dtype, device=v.device)
    flat = v.flatten(-2)
    bound = (flat.abs() >= 1).to(v.dtype) * flat
    acts = problem.acts.repeat_interleave(v.shape[-1], -1)
    steps, gains = [], []
    for k in reversed(range(problem.steps)):
        drift, push = model.state_matrix[:, k], model.control_matrix[:, k]
        ahead = push.mT @ curve
        sides = torch.cat([ahead @ drift, _times(push.mT, slope) + model.control_gradient[:, k].unsqueeze(-1)], -1)
        free = ((sides[..., -1] * bound[:, k] >= 0) * acts).unsqueeze(-1)
        hessian = model.control_hessian[:, k] + ahead @ push
        damped = hessian * free * free.mT + eye * (damping[:, None, None] + 1 - free)
        solved = -torch.linalg.solve_ex(damped, sides * free).result
        # with the policy dv = gain dx + step the model stays quadratic in dx
        left = sides[..., :states].mT + solved[..., :states].mT @ hessian
        slope = model.gradient[:, k] + (
            _times(drift.mT, slope) + left @ solved[..., states:] + solved[..., :states].mT @ sides[..., states:]
        ).squeeze(-1)
        curve = model.hessian[:, k] + drift.mT @ curve @ drift + left @ solved[..., :states]
        curve = curve + solved[..., :states].mT @ sides[..., :states]
        curve = (curve + curve.mT) / 2
        steps.append(solved[..., states])
        gains.append(solved[..., :states])
    return torch.stack(steps[::-1], 1), torch.stack(gains[::-1], 1)


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return matrix @ vector.unsqueeze(-1)


def _forward(
    problem: HeldControls, x: Tensor, v: Tensor, cost: Tensor, policy: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """The longest step that lowers the cost of each row, or none: states, scaled controls, cost."""
    best_x, best_v, best = x.clone(), v.clone(), cost.clone()
    rows = torch.arange(len(v), device=v.device)
    for length in STEP_LENGTHS:
        part, (steps, gains) = problem.rows(rows), (piece[rows] for piece in policy)
        state, path, controls = x[rows, 0], [x[rows, 0]], []
        for k in range(problem.steps):
            change = _times(gains[:, k], (state - x[rows, k]).flatten(-2)).squeeze(-1) + length * steps[:, k]
            controls.append((v[rows, k] + change.unflatten(-1, v.shape[-2:])).clamp(-1, 1))
            state = part.advance(k, state, controls[-1])
            path.append(state)
        new_x, new_v = torch.stack(path, 1), torch.stack(controls, 1)
        reached = part.cost(new_x, new_v).nan_to_num(torch.inf)
        lower = reached < cost[rows]
        done = rows[lower]
        best_x[done], best_v[done], best[done] = new_x[lower], new_v[lower], reached[lower]
        rows = rows[~lower]
        if len(rows) == 0:
            break
    return best_x, best_v, best
