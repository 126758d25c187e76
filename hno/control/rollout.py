"""Closed-loop simulation: all starts at once, zero-order hold, collisions looked for between steps too."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable

import torch
from torch import Tensor

from hno.control.belief import FixedBelief, all_learning
from hno.control.disturbance import Disturbance, believed, control_noise, normal, state_push
from hno.control.policy import Policy, as_policy
from hno.control.questions import starts
from hno.games import Game
from hno.games.kinematics import separation
from hno.pontryagin.integrate import runge_kutta
from hno.pontryagin.threads import torch_threads
from hno.types import Numbers, Trajectory

log = logging.getLogger(__name__)

__all__ = ["Disturbance", "Player", "control_steps", "rollout"]

Player = Policy | Callable[[Tensor, Tensor, Tensor], Tensor]
"""A policy, or a bare function (tau (B,), x (B, P, n), theta (B, P)) -> controls (B, P, m)."""


def rollout(
    game: Game,
    policy: Player,
    x0: Numbers,
    theta: Numbers,
    dt: float = 0.02,
    substeps: int = 4,
    points: int = 4,
    disturbance: Disturbance = Disturbance(),
    threads: int = 1,
) -> Trajectory:
    """Play the game from every start.

    The policy is never asked about states that are not finite: such a row has no controls (NaN) from then on, hence no
    clearance, and its place in the batch holds its start state. It counts as a collision, which a warning says.

    Args:
        game: the game.
        policy: feedback controls of all players.
        x0: start states, (B, P, n).
        theta: player types, (B, P), or (P,) for all.
        dt: time for which a control is held, s.
        substeps: Runge-Kutta steps within `dt`.
        points: states, interpolated within each of these, at which constraints and running costs are evaluated.
        disturbance: of controls, motion and beliefs.
        threads: of torch, see `torch_threads`.

    Raises:
        ValueError: shapes do not fit the game, a start is not finite, the horizon is not a whole multiple of `dt`, or
            states are pushed that the game does not have.
    """
    first, types = starts(game, x0, theta)
    with torch_threads(threads), torch.no_grad():
        played = _played(game, policy, first, types, dt, substeps, points, disturbance)
    if lost := int(played.lost.sum()):
        log.warning("%d of %d episodes do not stay finite: they count as collisions.", lost, len(first))
    return played


def control_steps(game: Game, dt: float) -> int:
    """Number of controls that an episode holds for `dt` each.

    Raises:
        ValueError: the horizon is not a whole multiple of `dt`.
    """
    steps = game.horizon / dt if math.isfinite(dt) and dt > 0 else 0.0
    if round(steps) < 1 or abs(steps - round(steps)) > 1e-6:
        raise ValueError(f"dt must be a positive time that divides the horizon of {game.horizon:g} s; got {dt:g} s.")
    return round(steps)


def _played(
    game: Game,
    policy: Player,
    x0: Tensor,
    theta: Tensor,
    dt: float,
    substeps: int,
    points: int,
    disturbance: Disturbance,
) -> Trajectory:
    steps = control_steps(game, dt)
    noise = control_noise(game, x0, theta, steps, disturbance)
    push = state_push(game, x0, theta, steps, disturbance)
    player = _believing(game, as_policy(policy), x0, theta, disturbance)
    player.reset(x0, theta)
    x, value = x0, torch.zeros_like(theta)
    clearance = distance = torch.full_like(theta[:, 0], torch.inf)
    path, controls, answers = [x], list[Tensor](), list[Tensor]()
    for k in range(steps):
        tau = torch.full_like(theta[:, 0], game.horizon - k * dt)
        finite = x.isfinite().all(-1).all(-1)[:, None, None]
        answers.append(player.act(tau, torch.where(finite, x, x0), theta).where(finite, torch.nan))
        u = answers[max(0, k - disturbance.delay)]
        if noise is not None:
            u = game.control_box.clamp(u + noise[:, k])
        inner = []
        for _ in range(substeps):
            after = runge_kutta(game, x, u, dt / substeps, push=None if push is None else push[:, k])
            inner.append(_between(x, after, points))
            x = after
        inside = torch.stack(inner, 1)
        types = theta[:, None, None].expand(inside.shape[:-1])
        constraint = game.constraint(inside, types)
        clearance = torch.minimum(clearance, -constraint.flatten(1).amax(1))
        distance = torch.minimum(distance, separation(game.positions(inside)).flatten(1).amin(1))
        rate = torch.trapezoid(game.uncontrolled_cost(inside, types, constraint), dx=1 / points, dim=2)
        value = value - dt * (game.effort(u) + rate.mean(1))
        path.append(x)
        controls.append(u)
        player.observe(torch.where(x.isfinite().all(-1).all(-1)[:, None, None], x, x0), u, dt)
    t = torch.linspace(0, game.horizon, steps + 1, dtype=x0.dtype, device=x0.device)
    value = value + game.terminal_value(x)
    return Trajectory(t, torch.stack(path, 1), torch.stack(controls, 1), value, clearance, distance)


def _believing(game: Game, policy: Policy, x0: Tensor, theta: Tensor, disturbance: Disturbance) -> Policy:
    """The policy of players who act on their own estimates of types.

    Raises:
        ValueError: they are to learn types about which they are to be mistaken, or see `hno.control.belief.Believing`.
    """
    if disturbance.belief and disturbance.learns:
        raise ValueError(
            "Players who learn types (learns) are not mistaken about them throughout (belief): choose one."
        )
    if disturbance.learns:
        return all_learning(policy, game, disturbance.learns)
    if disturbance.belief == 0:
        return policy
    drawn = normal("belief", disturbance.seed, x0, theta, (game.players, game.players))
    return FixedBelief(policy, believed(game, theta, drawn, disturbance.belief).flatten(0, 1))


def _between(start: Tensor, end: Tensor, points: int) -> Tensor:
    """Points on the chord from start to end, both included, (B, points + 1, P, n)."""
    share = torch.linspace(0, 1, points + 1, dtype=start.dtype, device=start.device)
    return torch.lerp(start.unsqueeze(1), end.unsqueeze(1), share[:, None, None])
