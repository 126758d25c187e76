from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from hno.games import Game, make
from hno.losses import Scales
from hno.operators import ValueOperator, operators
from hno.types import Points

GAMES = ("narrow_road", "lane_change", "drone")
ACTIVATIONS = ("tanh", "sin", "relu")

MakeOperator = Callable[..., ValueOperator]


@pytest.fixture
def make_operator() -> MakeOperator:
    """A small operator with random weights whose values and costates have the sizes of labels."""

    def build(game: str = "narrow_road", name: str = "hno", seed: int = 0, **options: Any) -> ValueOperator:
        torch.manual_seed(seed)
        operator = operators.get(name)(make(game), **({"width": 16, "depth": 2} | options))
        operator.set_scales(Scales(torch.tensor(40.0), torch.full_like(operator.costate_scale, 3.0)))
        return operator

    return build


def random_points(game: Game, size: int = 6, seed: int = 0, types: int | None = None) -> Points:
    """Points of the PDE box with few or all different types."""
    generator = torch.Generator().manual_seed(seed)
    tau = game.horizon * torch.rand(size, generator=generator)
    theta = game.type_box.sample(types or size, generator)
    which = torch.arange(size) % len(theta)
    dtype = game.state_box.lo.dtype
    return Points(tau.to(dtype), game.state_box.sample(size, generator), theta[which].to(dtype))
