"""What stands between a policy and the game as it was made for: noise, delays, pushes, wrong beliefs."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from hno.games import Game


class Disturbance(NamedTuple):
    """How an episode is disturbed.

    Random numbers of an episode depend on the seed, its start and its types alone: two policies meet the same ones.
    """

    noise: float = 0.0
    """Standard deviation of Gaussian noise of controls, new at every step, in half widths of the control box."""
    delay: int = 0
    """Steps by which controls come late; until the first one comes, it is applied in advance."""
    seed: int = 0
    """Of everything random."""
    drift: float = 0.0
    """Standard deviation of what a constant Gaussian push, new in every episode, adds to a state by itself over the
    horizon, in widths of the PDE box: wind, a heading that is off."""
    gusts: float = 0.0
    """The same of a push that is new at every step (white noise of the state's derivative)."""
    components: tuple[int, ...] | None = None
    """States that are pushed, by their place in a player's state; all by default."""
    belief: float = 0.0
    """By how much every player is mistaken about each other player's type throughout an episode, in widths of the type
    box; up or down by chance, but inwards where the type box ends. Its own type it knows."""
    learns: str | None = None
    """Every player knows its own type alone and learns those of the others: what it acts on, see
    `hno.control.belief.all_learning`."""


def control_noise(game: Game, x0: Tensor, theta: Tensor, steps: int, disturbance: Disturbance) -> Tensor | None:
    """What is added to controls, (B, steps, P, m)."""
    if disturbance.noise == 0:
        return None
    drawn = normal("noise", disturbance.seed, x0, theta, (steps, game.players, game.control_dim))
    return disturbance.noise * game.control_box.width / 2 * drawn


def state_push(game: Game, x0: Tensor, theta: Tensor, steps: int, disturbance: Disturbance) -> Tensor | None:
    """What is added to the time derivative of states, (B, steps, P, n)."""
    drift, gusts, joint = disturbance.drift, disturbance.gusts, (game.players, game.state_dim)
    if drift == gusts == 0:
        return None
    drawn = torch.zeros_like(x0).unsqueeze(1)
    if drift:
        drawn = drawn + drift * normal("drift", disturbance.seed, x0, theta, (1, *joint))
    if gusts:
        drawn = drawn + gusts * math.sqrt(steps) * normal("gusts", disturbance.seed, x0, theta, (steps, *joint))
    rate = drawn * pushed_states(game, disturbance.components) * game.state_box.width / game.horizon
    return rate.expand(-1, steps, -1, -1)


def pushed_states(game: Game, components: Sequence[int] | None) -> Tensor:
    """1 for states that are pushed, 0 for the others, (n,).

    Raises:
        ValueError: a place that no state of the game has.
    """
    mask = torch.zeros_like(game.state_box.lo[0])
    chosen = range(game.state_dim) if components is None else components
    if not all(0 <= place < game.state_dim for place in chosen):
        raise ValueError(f"components are places in a player's state, 0 to {game.state_dim - 1}; got {list(chosen)}.")
    mask[list(chosen)] = 1
    return mask


def believed(game: Game, theta: Tensor, drawn: Tensor, error: float) -> Tensor:
    """What each player takes all types to be: its own as it is, the others' off by `error` widths of the type box.

    Args:
        game: the game.
        theta: player types, (B, P).
        drawn: whose signs say whether estimates are too high or too low, (B, P, P).
        error: size of the error.

    Returns:
        Entry [..., i, j] is player i's estimate of the type of j, (B, P, P).
    """
    box, own = game.type_box, torch.eye(game.players, dtype=torch.bool, device=theta.device)
    true, step = theta.unsqueeze(-2).expand_as(drawn), error * box.width * drawn.sign()
    outside = (true + step < box.lo) | (true + step > box.hi)
    return torch.where(own, true, box.clamp(torch.where(outside, true - step, true + step)))


def normal(name: str, seed: int, x0: Tensor, theta: Tensor, shape: Sequence[int]) -> Tensor:
    """Standard normal numbers that depend on their name, the seed and the row's start and types alone.

    Each row has a counter-based generator of its own, Philox 4x64-10 (Salmon et al., SC 2011), whose key is a hash of
    all of these, in single precision; equal rows have equal numbers.

    Args:
        name: what the numbers are for; other names have other numbers.
        seed: of all of them.
        x0: start states, (B, P, n).
        theta: player types, (B, P).
        shape: of a row's numbers.

    Returns:
        Numbers of the type and on the device of `x0`, (B, *shape).
    """
    drawn = torch.empty((len(x0), *shape), dtype=x0.dtype)
    rows = torch.cat([x0.flatten(1), theta], 1).cpu().float().numpy()
    for row, content in zip(drawn, rows, strict=True):
        key = hashlib.sha256(f"{name}:{seed}:".encode() + content.tobytes()).digest()[:16]
        generator = np.random.Generator(np.random.Philox(key=int.from_bytes(key)))
        row.copy_(torch.from_numpy(generator.standard_normal(tuple(shape))))
    return drawn.to(x0.device)
