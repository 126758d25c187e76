"""Closed-loop simulation: all starts at once, zero-order hold, collisions looked for between steps too."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from hno.games import Game
from hno.games.kinematics import separation
from hno.pontryagin.integrate import runge_kutta
from hno.types import Trajectory

Policy = Callable[[Tensor, Tensor, Tensor], Tensor]
"""(tau (B,), x (B, P, n), theta (B, P)) -> controls (B, P, m)."""


class Disturbance(NamedTuple):
    """What stands between a policy's answer and the control that is applied."""

    noise: float = 0.0
    """Standard deviation of Gaussian noise, new at every step, in half widths of the control box."""
    delay: int = 0
    """Steps by which controls come late; until the first one comes, it is applied in advance."""
    seed: int = 0
    """Of the noise."""


@torch.no_grad()
def rollout(
    game: Game,
    policy: Policy,
    x0: Tensor,
    theta: Tensor,
    dt: float = 0.02,
    substeps: int = 4,
    points: int = 4,
    disturbance: Disturbance = Disturbance(),
) -> Trajectory:
    """Play the game from every start.

    Args:
        game: the game.
        policy: feedback controls of all players.
        x0: start states, (B, P, n).
        theta: player types, (B, P).
        dt: time for which a control is held, s.
        substeps: Runge-Kutta steps within `dt`.
        points: states, interpolated within each of these, at which constraint and penalty are evaluated.
        disturbance: of the controls.

    Raises:
        ValueError: the horizon is not a whole multiple of `dt`.
    """
    steps = control_steps(game, dt)
    x, value = x0, torch.zeros_like(theta)
    clearance = distance = torch.full_like(theta[:, 0], torch.inf)
    path, controls, answers = [x], list[Tensor](), list[Tensor]()
    generator = torch.Generator().manual_seed(disturbance.seed)
    for k in range(steps):
        tau = torch.full_like(theta[:, 0], game.horizon - k * dt)
        answers.append(policy(tau, x, theta))
        u = _disturbed(game, answers[max(0, k - disturbance.delay)], disturbance.noise, generator)
        for _ in range(substeps):
            after = runge_kutta(game, x, u, dt / substeps)
            inner = _between(x, after, points)
            constraint = game.constraint(inner, theta.unsqueeze(1).expand(-1, points + 1, -1))
            clearance = torch.minimum(clearance, -constraint.amax((-2, -1)))
            distance = torch.minimum(distance, separation(game.positions(inner)).amin((-2, -1)))
            penalty = torch.trapezoid(game.penalty(constraint), dx=1 / points, dim=1)
            value = value - dt / substeps * (game.effort(u) + penalty)
            x = after
        path.append(x)
        controls.append(u)
    t = torch.linspace(0, game.horizon, steps + 1, dtype=x0.dtype, device=x0.device)
    value = value + game.terminal_value(x)
    return Trajectory(t, torch.stack(path, 1), torch.stack(controls, 1), value, clearance, distance)


def control_steps(game: Game, dt: float) -> int:
    """Number of controls that an episode holds for `dt` each.

    Raises:
        ValueError: the horizon is not a whole multiple of `dt`.
    """
    steps = game.horizon / dt if math.isfinite(dt) and dt > 0 else 0.0
    if round(steps) < 1 or abs(steps - round(steps)) > 1e-6:
        raise ValueError(f"dt must be a positive time that divides the horizon of {game.horizon:g} s; got {dt:g} s.")
    return round(steps)


def _disturbed(game: Game, u: Tensor, noise: float, generator: torch.Generator) -> Tensor:
    """Admissible controls with noise added, (B, P, m)."""
    if noise == 0:
        return u
    box = game.control_box
    draw = torch.randn(u.shape, generator=generator, dtype=u.dtype).to(u.device)
    return box.clamp(u + noise * box.width / 2 * draw)


def _between(start: Tensor, end: Tensor, points: int) -> Tensor:
    """Points on the chord from start to end, both included, (B, points + 1, P, n)."""
    share = torch.linspace(0, 1, points + 1, dtype=start.dtype, device=start.device)
    return torch.lerp(start.unsqueeze(1), end.unsqueeze(1), share[:, None, None])
