"""A source of collocation points: where the players would be if nobody reacted to anybody.

Those are the states in which they meet, and on which everything depends that they do about it.
"""

from __future__ import annotations

import math
from typing import final

import torch
from torch import Tensor

from hno.data.sources import Known, Source
from hno.games import Game
from hno.pontryagin.integrate import runge_kutta
from hno.types import Points


@final
class Coasting(Source):
    """States on the way from the start box with the controls of least effort.

    Args:
        spread: standard deviation of what is added to states, in widths of the PDE box.
        steps: integration steps.

    Raises:
        ValueError: `spread` is no finite number of at least 0.
    """

    def __init__(self, spread: float = 0.02, steps: int = 8) -> None:
        if not (math.isfinite(spread) and spread >= 0):
            raise ValueError(f"sampler.coasting.spread must be a finite number of at least 0; got {spread!r}.")
        self.spread, self.steps = spread, steps

    def draw(self, game: Game, theta: Tensor, window: float, known: Known, generator: torch.Generator) -> Points:
        """Uniform times within the window, and where coasting leads until then."""
        tau = window * game.horizon * torch.rand(len(theta), generator=generator)
        x = game.initial_box.sample(len(theta), generator)
        step = ((game.horizon - tau) / self.steps)[:, None, None]
        for _ in range(self.steps):
            x = runge_kutta(game, x, game.best_response(x, torch.zeros_like(x)), step)
        noise = self.spread * torch.randn(x.shape, generator=generator) * game.state_box.width
        return Points(tau, game.state_box.clamp(x + noise), theta)
