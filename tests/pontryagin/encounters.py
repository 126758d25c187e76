"""Start states, states in which the penalty acts, and derivatives by finite differences."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from hno.games import Game, make

NAMES = ("narrow_road", pytest.param("lane_change", marks=pytest.mark.slow), "drone")
"""The second has the dynamics of the first."""
FIRST = ("narrow_road", *(pytest.param(name, marks=pytest.mark.slow) for name in ("lane_change", "drone")))
"""Where solving takes seconds."""
ENCOUNTERS = {
    "narrow_road": [[34.6, 4.5, 0.03, 21.0], [35.3, 3.2, -0.02, 19.0]],
    "lane_change": [[40.0, 3.0, 0.05, 20.0], [41.4, 5.3, -0.06, 22.0]],
    "drone": [[2.2, 2.8, 0.3, 2.5, 3.0, 0.1], [3.2, 1.5, -0.2, 3.1, 2.2, -0.2]],
}


def encounters(name: str, size: int = 16) -> tuple[Game, Tensor, Tensor]:
    """A float64 game, states (size, 2, n) around an encounter, and types (size, 2)."""
    game, generator = make(name).double(), torch.Generator().manual_seed(0)
    base = torch.tensor(ENCOUNTERS[name], dtype=torch.float64)
    jitter = 0.005 * game.state_box.width * torch.randn(size, *base.shape, generator=generator, dtype=torch.float64)
    return game, base + jitter, game.type_box.sample(size, generator)


def central_difference(function: Callable[[Tensor], Tensor], point: Tensor, step: float = 1e-5) -> Tensor:
    """d function / d point of a function of (..., B, P, n) with values (..., B, P), shape (B, P, P, n)."""
    players, states = point.shape[-2:]
    shifts = step * torch.eye(players * states, dtype=point.dtype).view(-1, *(1,) * (point.dim() - 2), players, states)
    slopes = (function(point + shifts) - function(point - shifts)) / (2 * step)
    return slopes.movedim(0, -1).unflatten(-1, (players, states))


def starts(game: Game, size: int, seed: int = 0) -> Tensor:
    """Random initial states, float64, (size, P, n)."""
    return game.initial_box.sample(size, torch.Generator().manual_seed(seed)).double()


def types(size: int, *theta: float) -> Tensor:
    """The same types for every row, (size, P)."""
    return torch.tensor([theta], dtype=torch.float64).expand(size, -1)
