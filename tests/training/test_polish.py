"""L-BFGS after the last step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from hno.operators import ValueOperator
from hno.operators.inputs import distinct_types
from hno.training.polish import polish
from hno.types import Batch, Labels, Sample
from tests.operators.conftest import ACTIVATIONS, MakeOperator, random_points

WEIGHTS = {"value": 1.0, "costate": 0.5, "boundary": 0.1, "residual": 0.02}


def smooth_batch(operator: ValueOperator, size: int = 24) -> Batch:
    """Labels that a net can come close to: those of another one."""
    points = [random_points(operator.game, size, seed, types=3) for seed in range(3)]
    x = points[0].x / operator.game.state_box.width
    value = -10 - 5 * x[..., 0].sin()
    costate = torch.zeros(size, 2, 2, operator.game.state_dim).to(x)
    end = points[2]._replace(tau=torch.zeros_like(points[2].tau))
    return {
        "bvp": Sample(points[0], Labels(value, costate), distinct_types(points[0].theta)),
        "interior": Sample(points[1]),
        "terminal": Sample(end),
    }


def loss(operator: ValueOperator, batch: Batch) -> float:
    with torch.no_grad():
        return float(sum(operator.weights[name] * term for name, term in operator.loss_terms(batch).items()))


def weights_of(operator: ValueOperator) -> list[Tensor]:
    return [weights.detach().clone() for weights in operator.net.parameters()]


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("name", ["hno", "sno"])
def test_polishing_lowers_the_loss_of_its_batch(make_operator: MakeOperator, activation: str, name: str) -> None:
    operator = make_operator(activation=activation, name=name, weights=WEIGHTS, norm="l2")
    batch = smooth_batch(operator)
    told = polish(operator, batch, 15)
    fresh = make_operator(activation=activation, name=name, weights=WEIGHTS, norm="l2")
    assert told == pytest.approx((loss(fresh, batch), loss(operator, batch)), rel=1e-6)
    assert told[1] < 0.9 * told[0]


def test_more_iterations_lower_it_further(make_operator: MakeOperator) -> None:
    after = []
    for iterations in (1, 5, 40):
        operator = make_operator(weights=WEIGHTS, norm="l2")
        after.append(polish(operator, smooth_batch(operator), iterations)[1])
    assert after[0] > after[1] > after[2]


def test_the_loss_is_the_weighted_one(make_operator: MakeOperator) -> None:
    """A term that hardly weighs is hardly lowered; terms of weight 0 need no stream."""
    ends = {}
    for name in ("value", "boundary"):
        operator = make_operator(weights=dict.fromkeys(WEIGHTS, 1e-6) | {name: 1.0}, norm="l2")
        batch = smooth_batch(operator)
        polish(operator, batch, 15)
        ends[name] = {term: float(value) for term, value in operator.loss_terms(batch).items()}
    assert ends["value"]["value"] < 0.3 * ends["boundary"]["value"]
    assert ends["boundary"]["boundary"] < 0.3 * ends["value"]["boundary"]
    only = make_operator(weights={"value": 1.0})
    assert polish(only, {"bvp": batch["bvp"]}, 3)[1] < loss(make_operator(weights={"value": 1.0}), batch)


def test_nothing_but_the_net_changes(make_operator: MakeOperator) -> None:
    operator = make_operator(weights=WEIGHTS, balance=True)
    batch = smooth_batch(operator)
    operator.running.fill_(0.5)
    before = {name: part.clone() for name, part in operator.state_dict().items()}
    polish(operator, batch, 3)
    changed = {name for name, part in operator.state_dict().items() if not torch.equal(part, before[name])}
    assert changed
    assert all(name.startswith("net.") for name in changed)


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
    make_operator: MakeOperator, monkeypatch: pytest.MonkeyPatch, step: Step
) -> None:
    operator = make_operator(weights=WEIGHTS)
    batch = smooth_batch(operator)
    before, kept = loss(operator, batch), weights_of(operator)
    monkeypatch.setattr(torch.optim.LBFGS, "step", step)
    assert polish(operator, batch, 5) == (pytest.approx(before), pytest.approx(before))
    assert all(map(torch.equal, weights_of(operator), kept))


def test_a_diverged_operator_is_left_as_it_is(make_operator: MakeOperator) -> None:
    operator = make_operator(weights=WEIGHTS)
    batch = smooth_batch(operator)
    with torch.no_grad():
        operator.net.trunk.layers[0].weight[0, 0] = torch.nan
    kept = weights_of(operator)
    polish(operator, batch, 3)
    assert all(
        torch.equal(a.nan_to_num(7.0), b.nan_to_num(7.0)) for a, b in zip(weights_of(operator), kept, strict=True)
    )


def test_polishing_is_deterministic(make_operator: MakeOperator) -> None:
    polished = []
    for seed in (1, 2):
        operator = make_operator(weights=WEIGHTS)
        batch = smooth_batch(operator)
        torch.manual_seed(seed)
        polish(operator, batch, 5)
        polished.append(weights_of(operator))
    assert all(map(torch.equal, *polished))
