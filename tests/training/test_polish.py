"""L-BFGS after the last step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from hno.games import Game
from hno.operators.inputs import distinct_types
from hno.training.module import TrainingModule
from hno.training.polish import polish
from hno.types import Batch, Labels, Sample
from tests.operators.conftest import ACTIVATIONS, MakeModule, random_points

WEIGHTS = {"value": 1.0, "costate": 0.5, "boundary": 0.1, "residual": 0.02}


def smooth_batch(game: Game, size: int = 24) -> Batch:
    """Labels that a net can come close to: those of another one."""
    points = [random_points(game, size, seed, types=3) for seed in range(3)]
    x = points[0].x / game.state_box.width
    value = -10 - 5 * x[..., 0].sin()
    costate = torch.zeros(size, 2, 2, game.state_dim).to(x)
    end = points[2]._replace(tau=torch.zeros_like(points[2].tau))
    return {
        "bvp": Sample(points[0], Labels(value, costate), distinct_types(points[0].theta)),
        "interior": Sample(points[1]),
        "terminal": Sample(end),
    }


def loss(module: TrainingModule, batch: Batch) -> float:
    weights = module.objective.weights
    with torch.no_grad():
        return float(sum(weights[name] * term for name, term in module.losses(batch).items()))


def weights_of(module: TrainingModule) -> list[Tensor]:
    return [weights.detach().clone() for weights in module.operator.parameters()]


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("name", ["hno", "sno"])
def test_polishing_lowers_the_loss_of_its_batch(make_module: MakeModule, activation: str, name: str) -> None:
    module = make_module(activation=activation, method=name, weights=WEIGHTS, norm="l2")
    batch = smooth_batch(module.operator.game)
    told = polish(module, batch, 15)
    fresh = make_module(activation=activation, method=name, weights=WEIGHTS, norm="l2")
    assert told == pytest.approx((loss(fresh, batch), loss(module, batch)), rel=1e-6)
    assert told[1] < 0.9 * told[0]


def test_more_iterations_lower_it_further(make_module: MakeModule) -> None:
    after = []
    for iterations in (1, 5, 40):
        module = make_module(weights=WEIGHTS, norm="l2")
        after.append(polish(module, smooth_batch(module.operator.game), iterations)[1])
    assert after[0] > after[1] > after[2]


def test_the_loss_is_the_weighted_one(make_module: MakeModule) -> None:
    """A term that hardly weighs is hardly lowered; terms of weight 0 need no stream."""
    ends = {}
    for name in ("value", "boundary"):
        module = make_module(weights=dict.fromkeys(WEIGHTS, 1e-6) | {name: 1.0}, norm="l2")
        batch = smooth_batch(module.operator.game)
        polish(module, batch, 15)
        ends[name] = {term: value.item() for term, value in module.losses(batch).items()}
    assert ends["value"]["value"] < 0.3 * ends["boundary"]["value"]
    assert ends["boundary"]["boundary"] < 0.3 * ends["value"]["boundary"]
    only = make_module(weights={"value": 1.0})
    assert polish(only, {"bvp": batch["bvp"]}, 3)[1] < loss(make_module(weights={"value": 1.0}), batch)


def test_nothing_but_the_net_changes(make_module: MakeModule) -> None:
    module = make_module(weights=WEIGHTS, balance=True)
    batch = smooth_batch(module.operator.game)
    module.objective.running.fill_(0.5)
    before = {name: part.clone() for name, part in module.state_dict().items()}
    polish(module, batch, 3)
    changed = {name for name, part in module.state_dict().items() if not torch.equal(part, before[name])}
    assert changed
    assert all(name.startswith("operator.networks.") for name in changed)


Step = Callable[[torch.optim.LBFGS, Callable[[], Any]], Any]


def ruined(self: torch.optim.LBFGS, closure: Callable[[], Any]) -> None:
    closure()
    with torch.no_grad():
        for weights in self.param_groups[0]["params"]:
            weights.mul_(3).add_(1)


def broken(self: torch.optim.LBFGS, closure: Callable[[], Any]) -> None:
    with torch.no_grad():
        for weights in self.param_groups[0]["params"]:
            weights.fill_(torch.nan)


def still(self: torch.optim.LBFGS, closure: Callable[[], Any]) -> None:
    closure()


@pytest.mark.parametrize("step", [ruined, broken, still])
def test_worse_weights_are_put_back_bit_for_bit(
    make_module: MakeModule, monkeypatch: pytest.MonkeyPatch, step: Step
) -> None:
    module = make_module(weights=WEIGHTS)
    batch = smooth_batch(module.operator.game)
    before, kept = loss(module, batch), weights_of(module)
    monkeypatch.setattr(torch.optim.LBFGS, "step", step)
    assert polish(module, batch, 5) == (pytest.approx(before), pytest.approx(before))
    assert all(map(torch.equal, weights_of(module), kept))


def test_a_diverged_operator_is_left_as_it_is(make_module: MakeModule) -> None:
    module = make_module(weights=WEIGHTS)
    batch = smooth_batch(module.operator.game)
    with torch.no_grad():
        module.operator.networks[0].trunk.layers[0].weight[0, 0] = torch.nan
    kept = weights_of(module)
    polish(module, batch, 3)
    assert all(torch.equal(a.nan_to_num(7.0), b.nan_to_num(7.0)) for a, b in zip(weights_of(module), kept, strict=True))


def test_polishing_is_deterministic(make_module: MakeModule) -> None:
    polished = []
    for seed in (1, 2):
        module = make_module(weights=WEIGHTS)
        batch = smooth_batch(module.operator.game)
        torch.manual_seed(seed)
        polish(module, batch, 5)
        polished.append(weights_of(module))
    assert all(map(torch.equal, *polished))
