from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
import torch
from torch import Tensor

from hno.games import make
from hno.operators import ValueOperator, operators
from hno.operators.optimizers import make_optimizer
from hno.registry import UnknownNameError
from hno.types import Batch, Labels, Points, Sample
from tests.operators.conftest import ACTIVATIONS, MakeOperator, random_points

STREAMS = ("bvp", "interior", "terminal")


@pytest.fixture(autouse=True)
def quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    """Operators train without a Lightning trainer here, so there is nobody to log to."""
    monkeypatch.setattr(ValueOperator, "log", lambda *args, **kwargs: None)
    monkeypatch.setattr(ValueOperator, "log_dict", lambda *args, **kwargs: None)


def in_contact(x: Tensor) -> Tensor:
    """Joint states of the narrow road in which the cars are side by side, so that the penalty feels the radius."""
    x = x.clone()
    x[:, 1, 0] = 70 - x[:, 0, 0]
    return x


def random_batch(operator: ValueOperator, size: int = 8) -> Batch:
    game = operator.game
    points = {name: random_points(game, size, seed) for seed, name in enumerate(STREAMS)}
    points["terminal"] = points["terminal"]._replace(tau=torch.zeros_like(points["terminal"].tau))
    points["interior"] = points["interior"]._replace(x=in_contact(points["interior"].x))
    value, costate = torch.randn(size, 2), torch.randn(size, 2, 2, game.state_dim)
    labels = Labels(40 * value.to(points["bvp"].x), 3 * costate.to(points["bvp"].x))
    return {name: Sample(at, labels if name == "bvp" else None) for name, at in points.items()}


def rows(batch: Batch, index: torch.Tensor) -> Batch:
    return {
        name: Sample(
            Points(*(part[index] for part in sample.points)),
            None if sample.labels is None else Labels(*(part[index] for part in sample.labels)),
        )
        for name, sample in batch.items()
    }


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_slopes_of_trunk_and_branch_move_apart(make_operator: MakeOperator, activation: str) -> None:
    """Published defect 2: both slopes shared one storage."""
    operator = make_operator(activation=activation)
    batch = random_batch(operator)
    optimizer = torch.optim.SGD(operator.net.parameters(), lr=1e-4)  # Adam's first steps are of one size
    slopes = operator.net.trunk.activation.slope, operator.net.branch.activation.slope
    for step in range(5):
        optimizer.zero_grad()
        operator.training_step(batch, step).backward()
        optimizer.step()
    assert min(abs(slope.item() - 0.1) for slope in slopes) > 1e-5
    assert abs(slopes[0].item() - slopes[1].item()) > 1e-6


@pytest.mark.parametrize("scaled", [True, False])
def test_loss_is_a_mean_over_rows(make_operator: MakeOperator, scaled: bool) -> None:
    """Published defect 6: sums over rows, so that a weight means something else at another batch size."""
    operator = make_operator(scaled=scaled).double()
    batch = random_batch(operator, 6)
    whole = operator.training_step(batch, 0)
    singles = [operator.training_step(rows(batch, torch.tensor([row])), 0) for row in range(6)]
    torch.testing.assert_close(whole, torch.stack(singles).mean())
    twice = operator.training_step(rows(batch, torch.arange(6).repeat(2)), 0)
    torch.testing.assert_close(twice, whole)


def test_residual_takes_the_theta_of_its_own_row(make_operator: MakeOperator) -> None:
    """Published defect 1, in the loss: rolling the types of the collocation rows must change it."""
    operator = make_operator(weights={"residual": 1.0}).double()
    batch = {"interior": random_batch(operator)["interior"]}
    at = batch["interior"].points
    rolled = {"interior": Sample(at._replace(theta=at.theta.roll(1, 0)))}
    assert operator.training_step(batch, 0).item() != pytest.approx(operator.training_step(rolled, 0).item(), rel=1e-6)


ALL = {"value": 1.0, "costate": 1.0, "boundary": 0.1, "residual": 0.1}


@pytest.mark.parametrize(
    ("name", "weights", "streams"),
    [
        ("hno", ALL, {"bvp", "interior", "terminal"}),
        ("sno", ALL, {"bvp"}),
        ("hno", None, {"bvp", "interior", "terminal"}),
        ("sno", None, {"bvp"}),
        ("hno", ALL | {"boundary": 0.0}, {"bvp", "interior"}),
        ("hno", ALL | {"residual": 0.0}, {"bvp", "terminal"}),
        ("hno", ALL | {"residual": 0.0, "boundary": 0.0}, {"bvp"}),
        ("hno", {"value": 1.0}, {"bvp"}),
        ("hno", {"residual": 1.0}, {"interior"}),
    ],
)
def test_streams_are_those_of_the_weighted_terms(
    make_operator: MakeOperator, name: str, weights: Mapping[str, float] | None, streams: set[str]
) -> None:
    assert make_operator(name=name, weights=weights).streams == streams


def test_weights_of_foreign_terms_are_ignored(make_operator: MakeOperator) -> None:
    assert make_operator(name="sno", weights=ALL).weights == {"value": 1.0, "costate": 1.0}


@pytest.mark.parametrize(
    "weights",
    [dict.fromkeys(ALL, 0.0), ALL | {"value": -1.0}, ALL | {"costate": float("nan")}, ALL | {"residual": float("inf")}],
)
def test_impossible_weights_are_refused(make_operator: MakeOperator, weights: Mapping[str, float]) -> None:
    with pytest.raises(ValueError, match="Loss weights must be finite, not negative and not all 0"):
        make_operator(weights=weights)


def test_a_term_of_weight_zero_changes_nothing(make_operator: MakeOperator) -> None:
    supervised = make_operator(name="sno")
    operator = make_operator(weights=ALL | {"residual": 0.0, "boundary": 0.0})
    batch = random_batch(operator)
    torch.testing.assert_close(operator.training_step(batch, 0), supervised.training_step(batch, 0))


def test_terms_without_their_stream_wait(make_operator: MakeOperator) -> None:
    operator, supervised = make_operator(weights=ALL), make_operator(name="sno")
    batch = {"bvp": random_batch(operator)["bvp"]}
    torch.testing.assert_close(operator.training_step(batch, 0), supervised.training_step(batch, 0))


def test_loss_adds_the_weighted_terms(make_operator: MakeOperator) -> None:
    batch = random_batch(make_operator())
    single = {name: make_operator(weights={name: 1.0}).training_step(batch, 0).detach() for name in ALL}
    total = make_operator(weights=ALL).training_step(batch, 0).detach()
    torch.testing.assert_close(total, sum(ALL[name] * loss for name, loss in single.items()))


def test_training_needs_an_optimizer(make_operator: MakeOperator) -> None:
    with pytest.raises(ValueError, match="without an optimizer"):
        make_operator().configure_optimizers()


@pytest.mark.parametrize(
    ("changes", "near"),
    [({"name": "adamm"}, "'adam'"), ({"name": "saop"}, "'soap'"), ({"schedule": "cosin"}, "'cosine'")],
)
def test_unknown_optimizer_or_schedule_lists_the_known_ones(changes: dict[str, Any], near: str) -> None:
    arguments = {"name": "adam", "steps": 10, "lr": 1e-3, "schedule": "constant", "final_lr": 0.0}
    with pytest.raises(UnknownNameError, match=rf"Known: .*{near[1:-1]}.* Did you mean {near}\?"):
        make_optimizer(**(arguments | changes))


def rates(schedule: str, steps: int = 10) -> list[float]:
    weight = torch.nn.Parameter(torch.zeros(1))
    built = make_optimizer("adam", steps, lr=1e-2, schedule=schedule, final_lr=1e-4)([weight])
    seen = []
    for _ in range(steps + 1):
        seen.append(built["optimizer"].param_groups[0]["lr"])
        built["optimizer"].step()
        if "lr_scheduler" in built:
            built["lr_scheduler"]["scheduler"].step()
    return seen


def test_constant_rate() -> None:
    assert set(rates("constant")) == {1e-2}


def test_cosine_rate_falls_from_the_first_to_the_last_step() -> None:
    seen = rates("cosine")
    assert seen[0] == pytest.approx(1e-2)
    assert seen[5] == pytest.approx((1e-2 + 1e-4) / 2)
    assert seen[-1] == pytest.approx(1e-4)
    assert sorted(seen, reverse=True) == seen


@pytest.mark.parametrize("name", ["adam", "adamw", "soap"])
def test_every_optimizer_lowers_a_loss(make_operator: MakeOperator, name: str) -> None:
    operator = make_operator(name="sno")
    batch = random_batch(operator, 32)
    built = make_optimizer(name, 30, lr=3e-3, schedule="constant", final_lr=0.0)(operator.net.parameters())
    losses = []
    for step in range(30):
        built["optimizer"].zero_grad()
        loss = operator.training_step(batch, step)
        loss.backward()
        built["optimizer"].step()
        losses.append(loss.item())
    assert losses[-1] < 0.98 * losses[0]


def test_norms_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match="huber, l1, l2"):
        operators.get("hno")(make("drone"), norm="l3")


@pytest.mark.parametrize("name", ["adam", "adamw", "soap"])
def test_unknown_optimizer_options_are_refused_before_training(name: str) -> None:
    with pytest.raises(KeyError, match="No option of"):
        make_optimizer(name, steps=3, lr=1e-3, schedule="constant", final_lr=0.0, foo=1)
