from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import pytest
import torch

from hno.games import Game, make
from hno.losses import Scales, make_objective
from hno.operators import Architecture, Choice, ValueOperator
from hno.operators import make_operator as built
from hno.operators.inputs import distinct_types
from hno.training.module import TrainingModule
from hno.types import Batch, Labels, Points, Sample

GAMES = ("narrow_road", "lane_change", "drone")
ACTIVATIONS = ("tanh", "sin", "relu")
METHODS = {
    "hno": {"value": 1.0, "costate": 1.0, "boundary": 1.0, "residual": 1.0},
    "sno": {"value": 1.0, "costate": 1.0},
}
"""Terms of each method, and weights that give every one of them a say."""

MakeOperator = Callable[..., ValueOperator]
MakeModule = Callable[..., TrainingModule]


def architecture(
    activation: str = "tanh", width: int = 16, depth: int = 2, exact_terminal: bool = False, members: int = 1
) -> Architecture:
    """A small operator."""
    return Architecture(
        Choice("value", {"exact_terminal": exact_terminal, "members": members}),
        Choice("deeponet", {"width": width, "depth": depth}),
        Choice(activation),
    )


def small_operator(game: str | Game = "narrow_road", seed: int = 0, **options: Any) -> ValueOperator:
    """A small operator with random weights whose values and costates have the sizes of labels."""
    torch.manual_seed(seed)
    operator = built(make(game) if isinstance(game, str) else game, architecture(**options))
    operator.set_scales(Scales(torch.tensor(40.0), torch.full_like(operator.costate_scale, 3.0)))
    return operator


def module_of(
    operator: ValueOperator, method: str = "hno", weights: Mapping[str, float] | None = None, **objective: Any
) -> TrainingModule:
    """An operator and the terms of a method, or those that have a weight."""
    weights = METHODS[method] if weights is None else weights
    return TrainingModule(operator, make_objective({name: {} for name in weights}, weights, **objective))


@pytest.fixture
def make_operator() -> MakeOperator:
    """See `small_operator`."""
    return small_operator


@pytest.fixture
def make_module(monkeypatch: pytest.MonkeyPatch) -> MakeModule:
    """A training module around `small_operator`; it trains without a trainer here, so there is nobody to log to."""
    monkeypatch.setattr(TrainingModule, "log", lambda *args, **kwargs: None)
    monkeypatch.setattr(TrainingModule, "log_dict", lambda *args, **kwargs: None)

    def build(
        game: str | Game = "narrow_road",
        method: str = "hno",
        seed: int = 0,
        weights: Mapping[str, float] | None = None,
        norm: str = "l1",
        scaled: bool = True,
        balance: bool = False,
        hardest: float = 1.0,
        **options: Any,
    ) -> TrainingModule:
        operator = small_operator(game, seed, **options)
        return module_of(operator, method, weights, norm=norm, scaled=scaled, balance=balance, hardest=hardest)

    return build


def random_points(game: Game, size: int = 6, seed: int = 0, types: int | None = None) -> Points:
    """Points of the PDE box with few or all different types."""
    generator = torch.Generator().manual_seed(seed)
    tau = game.horizon * torch.rand(size, generator=generator)
    theta = game.type_box.sample(types or size, generator)
    which = torch.arange(size) % len(theta)
    dtype = game.state_box.lo.dtype
    return Points(tau.to(dtype), game.state_box.sample(size, generator), theta[which].to(dtype))


def random_batch(game: Game, size: int = 8) -> Batch:
    """Every stream, with arbitrary labels from the global generator; players of two-player games are in contact."""
    points = {name: random_points(game, size, seed) for seed, name in enumerate(("bvp", "interior", "terminal"))}
    points["terminal"] = points["terminal"]._replace(tau=torch.zeros_like(points["terminal"].tau))
    inside = points["interior"].x.clone()
    inside[:, 1, 0] = 70 - inside[:, 0, 0]  # on the narrow road, cars side by side: the penalty feels the radius
    points["interior"] = points["interior"]._replace(x=inside)
    value, costate = (
        torch.randn(size, game.players),
        torch.randn(size, game.players, game.players, game.state_dim),
    )
    labels = Labels(40 * value.to(inside), 3 * costate.to(inside))
    return {name: Sample(at, labels if name == "bvp" else None) for name, at in points.items()}


def with_tables(batch: Batch) -> Batch:
    """As the datamodule makes batches."""
    return {name: sample._replace(types=distinct_types(sample.points.theta)) for name, sample in batch.items()}
