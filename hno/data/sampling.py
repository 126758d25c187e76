"""Collocation points, as pure functions of a generator."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from hno.games import Game
from hno.pontryagin.adjoint import gradient_of
from hno.types import Points

SOURCES = ("box", "band", "labels", "rollout")
"""Uniform in the PDE box; near the surface constraint = 0; around states of labels; of closed-loop episodes."""


def check_shares(shares: Mapping[str, float]) -> None:
    """Raise ValueError unless the shares name known sources, are finite, not negative and do not all vanish."""
    unknown = set(shares) - set(SOURCES)
    sound = all(math.isfinite(share) and share >= 0 for share in shares.values())
    if unknown or not sound or sum(shares.values()) <= 0:
        raise ValueError(
            f"Sampler shares must be nonnegative numbers for {', '.join(SOURCES)}, not all 0; got {dict(shares)}."
        )


def sample_states(
    game: Game,
    theta: Tensor,
    shares: Mapping[str, float],
    pools: Mapping[str, tuple[Tensor, Tensor]],
    window: float,
    generator: torch.Generator,
    spread: float = 0.05,
    band: float = 1.5,
) -> Points:
    """Collocation points of given types.

    Args:
        game: the game.
        theta: type of each row, (B, P).
        shares: how many points come from each of `SOURCES`, in any unit.
        pools: for "labels" and "rollout", times to go (L,), 0 among them, and states (L, P, n) to draw points around.
        window: share of the horizon that tau may reach.
        generator: source of randomness.
        spread: standard deviation around the states of a pool, in box widths.
        band: constraint values of the band lie in [-band, 0.2 band], m for distance constraints.

    Returns:
        Points in the PDE box with tau in the window, (B,), (B, P, n), (B, P).
    """
    size = len(theta)
    source = _sources(size, shares, generator)
    tau = window * game.horizon * torch.rand(size, generator=generator)
    x = game.state_box.sample(size, generator)
    target = band * (1.2 * torch.rand(size, generator=generator) - 1)

    for name, (times, states) in pools.items():
        near = (source == SOURCES.index(name)).nonzero().squeeze(-1)
        inside = (times <= window * game.horizon).nonzero().squeeze(-1)
        if len(inside) == 0:
            continue  # episodes that were not finite: these points stay uniform
        row = inside[torch.randint(len(inside), (len(near),), generator=generator)]
        noise = spread * torch.randn(x[near].shape, generator=generator) * game.state_box.width
        tau[near], x[near] = times[row], game.state_box.clamp(states[row] + noise)

    rows = (source == SOURCES.index("band")).nonzero().squeeze(-1)
    x[rows] = onto_band(game, x[rows], theta[rows], target[rows])
    return Points(tau, x, theta)


def onto_band(game: Game, x: Tensor, theta: Tensor, target: Tensor, iterations: int = 3) -> Tensor:
    """Move states until their largest constraint is about `target`, inside the PDE box.

    Args:
        game: the game.
        x: states, (B, P, n).
        theta: types, (B, P).
        target: constraint values to reach, (B,).
        iterations: Newton steps along the constraint's gradient, in box widths.
    """
    width = game.state_box.width
    for _ in range(iterations):
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            worst = game.constraint(x, theta).amax((-2, -1))
            slope = gradient_of(worst.sum(), x) * width
        size = slope.square().sum((-2, -1)).clamp_min(1e-12)
        step = ((target - worst.detach()) / size)[:, None, None] * slope * width
        x = game.state_box.clamp(x.detach() + step)
    return x.detach()


def _sources(size: int, shares: Mapping[str, float], generator: torch.Generator) -> Tensor:
    """Index into `SOURCES` for each row, (size,)."""
    weights = torch.tensor([float(shares.get(name, 0)) for name in SOURCES])
    return torch.multinomial(weights, size, replacement=True, generator=generator)
