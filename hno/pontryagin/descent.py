"""Batched differential dynamic programming on the joint problem, with controls clamped to their box."""

from __future__ import annotations

import torch
from torch import Tensor

from hno.pontryagin.joint import Expansion, JointProblem

STEP_LENGTHS = (1.0, 0.5, 0.2, 0.05)
"""Step lengths that are tried side by side."""


def descend(
    problem: JointProblem, start: Tensor, v: Tensor, iterations: int, tolerance: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Lower the joint cost of every row.

    Args:
        problem: the joint problem of R rows.
        start: initial states, (R, P, n).
        v: scaled controls to start from, (R, N, P, m).
        iterations: iteration budget.
        tolerance: relative decrease below which a row is left alone.

    Returns:
        States (R, N + 1, P, n), scaled controls (R, N, P, m) and joint costs (R,).
    """
    v = v.clone()
    x = problem.rollout(start, v)
    cost = problem.cost(x, v)
    damping = torch.full_like(cost, 1e-2)
    active = torch.arange(len(cost), device=cost.device)
    for _ in range(iterations):
        part = problem.rows(active)
        policy = _backward(part.expand(x[active], v[active]), v[active], damping[active])
        moved_x, moved_v, reached = _forward(part, x[active], v[active], policy)
        gain = cost[active] - reached
        better = gain > 0
        rows = active[better]
        x[rows], v[rows], cost[rows] = moved_x[better], moved_v[better], reached[better]
        damping[active] *= torch.where(better, 0.3, 10.0)
        going = torch.where(better, gain > tolerance * cost[active].abs(), damping[active] < 1e6)
        active = active[going]
        if len(active) == 0:
            break
    return x, v, cost


def _backward(model: Expansion, v: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
    """Open-loop steps (R, N, M) and feedback gains (R, N, M, D) that minimise the model."""
    slope, curve = model.end_gradient, model.end_hessian
    states = slope.shape[-1]
    eye = torch.eye(model.gradient.shape[-1] - states, dtype=v.dtype, device=v.device)
    bound, flat = v.abs() >= 1, v.flatten(-2)
    steps, gains = [], []
    for k in reversed(range(model.gradient.shape[1])):
        move = model.dynamics[:, k]
        gradient = model.gradient[:, k] + (slope.unsqueeze(-2) @ move).squeeze(-2)
        hessian = model.hessian[:, k] + move.mT @ curve @ move
        control_gradient = gradient[:, states:]
        held = bound[:, k].flatten(-2) & (control_gradient * flat[:, k] < 0)
        free = (~held).to(v.dtype).unsqueeze(-1)
        damped = hessian[:, states:, states:] * free * free.mT + eye * (damping[:, None, None] + 1 - free)
        sides = torch.cat([hessian[:, states:, :states], control_gradient.unsqueeze(-1)], -1)
        solved = -torch.linalg.solve_ex(damped, sides * free).result
        gain, step = solved[..., :states], solved[..., states]
        closed = hessian[:, :states] + gain.mT @ hessian[:, states:]
        curve = closed[..., :states] + closed[..., states:] @ gain
        curve = (curve + curve.mT) / 2
        slope = gradient[:, :states] + (closed[..., states:] @ step.unsqueeze(-1)).squeeze(-1)
        slope = slope + (gain.mT @ control_gradient.unsqueeze(-1)).squeeze(-1)
        steps.append(step)
        gains.append(gain)
    return torch.stack(steps[::-1], 1), torch.stack(gains[::-1], 1)


def _forward(
    problem: JointProblem, x: Tensor, v: Tensor, policy: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """The best of several step lengths for each row: states, scaled controls, cost."""
    steps, gains = policy
    lengths = torch.tensor(STEP_LENGTHS, dtype=v.dtype, device=v.device)
    rows = torch.arange(len(v), device=v.device).repeat(len(lengths))
    scale = lengths.repeat_interleave(len(v)).unsqueeze(-1)
    many = problem.rows(rows)
    state, path, controls = x[rows, 0], [x[rows, 0]], []
    for k in range(problem.steps):
        offset = (gains[rows, k] @ (state - x[rows, k]).flatten(-2).unsqueeze(-1)).squeeze(-1)
        control = v[rows, k] + (scale * steps[rows, k] + offset).unflatten(-1, v.shape[-2:])
        controls.append(control.clamp(-1, 1))
        state = problem.advance(state, controls[-1])
        path.append(state)
    new_x, new_v = torch.stack(path, 1), torch.stack(controls, 1)
    cost = many.cost(new_x, new_v).nan_to_num(torch.inf).view(len(lengths), -1)
    best, which = cost.min(0)
    pick = which * len(v) + torch.arange(len(v), device=v.device)
    return new_x[pick], new_v[pick], best
