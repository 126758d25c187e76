from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import pytest
import torch
from torch import Tensor

from hno.losses import Norm, View, hji_residual
from hno.losses.hji import Boundary
from hno.operators.inputs import distinct_types
from hno.registry import UnknownNameError
from hno.training.module import TrainingModule
from hno.training.optimizers import FACTORIES, SCHEDULES, make_optimizer, muon
from hno.types import Batch, Labels, Points, Sample
from tests.operators.conftest import ACTIVATIONS, MakeModule, MakeOperator, random_batch, random_points


def rows(batch: Batch, index: torch.Tensor) -> Batch:
    return {
        name: Sample(
            Points(*(part[index] for part in sample.points)),
            None if sample.labels is None else Labels(*(part[index] for part in sample.labels)),
        )
        for name, sample in batch.items()
    }


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_slopes_of_trunk_and_branch_move_apart(make_module: MakeModule, activation: str) -> None:
    """Published defect 2: both slopes shared one storage."""
    module = make_module(activation=activation)
    batch = random_batch(module.operator.game)
    optimizer = torch.optim.SGD(module.operator.parameters(), lr=1e-4)  # Adam's first steps are of one size
    slopes = module.operator.networks[0].trunk.activation.slope, module.operator.networks[0].branch.activation.slope
    for step in range(5):
        optimizer.zero_grad()
        module.training_step(batch, step).backward()
        optimizer.step()
    assert min(abs(slope.item() - 0.1) for slope in slopes) > 1e-5
    assert abs(slopes[0].item() - slopes[1].item()) > 1e-6


@pytest.mark.parametrize("scaled", [True, False])
def test_loss_is_a_mean_over_rows(make_module: MakeModule, scaled: bool) -> None:
    """Published defect 6: sums over rows, so that a weight means something else at another batch size."""
    module = make_module(scaled=scaled).double()
    batch = random_batch(module.operator.game, 6)
    whole = module.training_step(batch, 0)
    singles = [module.training_step(rows(batch, torch.tensor([row])), 0) for row in range(6)]
    torch.testing.assert_close(whole, torch.stack(singles).mean())
    twice = module.training_step(rows(batch, torch.arange(6).repeat(2)), 0)
    torch.testing.assert_close(twice, whole)


def test_residual_takes_the_theta_of_its_own_row(make_module: MakeModule) -> None:
    """Published defect 1, in the loss: rolling the types of the collocation rows must change it."""
    module = make_module(weights={"residual": 1.0}).double()
    batch = {"interior": random_batch(module.operator.game)["interior"]}
    at = batch["interior"].points
    rolled = {"interior": Sample(at._replace(theta=at.theta.roll(1, 0)))}
    assert module.training_step(batch, 0).item() != pytest.approx(module.training_step(rolled, 0).item(), rel=1e-6)


ALL = {"value": 1.0, "costate": 1.0, "boundary": 0.1, "residual": 0.1}


@pytest.mark.parametrize(
    ("name", "weights", "streams"),
    [
        ("hno", ALL, {"bvp", "interior", "terminal"}),
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
    make_module: MakeModule, name: str, weights: Mapping[str, float] | None, streams: set[str]
) -> None:
    assert make_module(method=name, weights=weights).streams == streams


def test_a_boundary_that_holds_exactly_needs_no_points(make_module: MakeModule) -> None:
    """The term is 0 there."""
    module, free = (make_module(weights=ALL, exact_terminal=exact) for exact in (True, False))
    assert module.streams == free.streams - {"terminal"}
    module.load_state_dict(free.state_dict())
    operator, batch = module.operator, random_batch(module.operator.game)
    field = operator.field(batch["terminal"].points)
    view = View(
        operator.game,
        operator.problem,
        batch["terminal"],
        field,
        lambda at: operator.field(at, None),
        operator.scales,
        0,
    )
    assert Boundary().residual(view).abs().max() == 0
    assert module.losses(batch).keys() == free.losses(batch).keys() - {"boundary"}


@pytest.mark.parametrize(
    "weights",
    [dict.fromkeys(ALL, 0.0), ALL | {"value": -1.0}, ALL | {"costate": float("nan")}, ALL | {"residual": float("inf")}],
)
def test_impossible_weights_are_refused(make_module: MakeModule, weights: Mapping[str, float]) -> None:
    with pytest.raises(ValueError, match="Loss weights must be finite, not negative and not all 0"):
        make_module(weights=weights)


def test_a_term_of_weight_zero_changes_nothing(make_module: MakeModule) -> None:
    supervised = make_module(method="sno")
    module = make_module(weights=ALL | {"residual": 0.0, "boundary": 0.0})
    batch = random_batch(module.operator.game)
    torch.testing.assert_close(module.training_step(batch, 0), supervised.training_step(batch, 0))


def test_terms_without_their_stream_wait(make_module: MakeModule) -> None:
    module, supervised = make_module(weights=ALL), make_module(method="sno")
    batch = {"bvp": random_batch(module.operator.game)["bvp"]}
    torch.testing.assert_close(module.training_step(batch, 0), supervised.training_step(batch, 0))


def test_loss_adds_the_weighted_terms(make_module: MakeModule) -> None:
    batch = random_batch(make_module().operator.game)
    single = {name: make_module(weights={name: 1.0}).training_step(batch, 0).detach() for name in ALL}
    total = make_module(weights=ALL).training_step(batch, 0).detach()
    torch.testing.assert_close(total, sum(ALL[name] * loss for name, loss in single.items()))


def test_training_needs_an_optimizer(make_module: MakeModule) -> None:
    with pytest.raises(ValueError, match="without an optimizer"):
        make_module().configure_optimizers()


@pytest.mark.parametrize(
    ("changes", "near"),
    [
        ({"name": "adamm"}, "'adam'"),
        ({"name": "saop"}, "'soap'"),
        ({"name": "moun"}, "'muon'"),
        ({"schedule": "cosin"}, "'cosine'"),
        ({"schedule": "liner"}, "'linear'"),
    ],
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


def test_linear_rate_falls_by_the_same_amount_every_step() -> None:
    assert rates("linear") == pytest.approx([1e-2 + (1e-4 - 1e-2) * step / 10 for step in range(11)])


@pytest.mark.parametrize("schedule", ["cosine", "linear"])
def test_a_rate_that_has_fallen_stays(schedule: str) -> None:
    weight = torch.nn.Parameter(torch.zeros(1))
    built = make_optimizer("adam", 4, lr=1e-2, schedule=schedule, final_lr=1e-4)([weight])
    for _ in range(9):
        built["optimizer"].step()
        built["lr_scheduler"]["scheduler"].step()
    assert built["optimizer"].param_groups[0]["lr"] == pytest.approx(1e-4)
    assert built["lr_scheduler"]["interval"] == "step"


@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize("name", sorted(FACTORIES))
def test_a_schedule_scales_the_rate_of_every_group(make_operator: MakeOperator, name: str, schedule: str) -> None:
    parameters = list(make_operator().parameters())
    built = make_optimizer(name, 10, lr=1e-2, schedule=schedule, final_lr=1e-3)(parameters)
    optimizer, first = built["optimizer"], [group["lr"] for group in built["optimizer"].param_groups]
    assert sum(len(group["params"]) for group in optimizer.param_groups) == len(parameters)
    shares = {"constant": (1.0, 1.0), "cosine": (0.55, 0.1), "linear": (0.55, 0.1)}[schedule]
    for share in shares:
        for _ in range(5):
            optimizer.step()
            if "lr_scheduler" in built:
                built["lr_scheduler"]["scheduler"].step()
        assert [group["lr"] for group in optimizer.param_groups] == pytest.approx([share * lr for lr in first])


def test_the_rate_that_a_schedule_scales_is_the_one_that_is_applied(make_module: MakeModule) -> None:
    """Muon has rates of two kinds; at rate 0 nothing may move, whatever its kind."""
    module = make_module()
    built = make_optimizer("muon", 1, lr=2e-2, schedule="linear", final_lr=0.0)(module.operator.parameters())
    batch = random_batch(module.operator.game)
    moved = []
    for step in range(2):
        before = [weights.detach().clone() for weights in module.operator.parameters()]
        built["optimizer"].zero_grad()
        module.training_step(batch, step).backward()
        built["optimizer"].step()
        built["lr_scheduler"]["scheduler"].step()
        moved.append([not torch.equal(w, old) for w, old in zip(module.operator.parameters(), before, strict=True)])
    assert all(moved[0])
    assert not any(moved[1])


def test_muon_is_for_matrices_and_adamw_for_everything_else(make_operator: MakeOperator) -> None:
    net = make_operator().networks[0]
    optimizer = muon(net.parameters(), lr=2e-2, adamw_lr=5e-3)
    groups = {group["use_muon"]: group for group in optimizer.param_groups}
    assert {id(weights) for weights in groups[True]["params"]} == {id(w) for w in net.parameters() if w.dim() == 2}
    assert {id(weights) for weights in groups[False]["params"]} == {id(w) for w in net.parameters() if w.dim() < 2}
    assert any(w is net.trunk.activation.slope for w in groups[False]["params"])
    assert (groups[True]["lr"], groups[False]["lr"]) == (2e-2, 5e-3)


def test_muon_moves_matrices_by_an_orthogonal_step_and_others_by_their_own_rate() -> None:
    """Newton-Schulz brings all singular values near 1, whatever the gradient's; Adam's first step is its rate."""
    torch.manual_seed(0)
    matrix, vector = torch.nn.Parameter(torch.zeros(6, 4)), torch.nn.Parameter(torch.zeros(5))
    matrix.grad = torch.linalg.qr(torch.randn(6, 6))[0][:, :4] * torch.tensor([100.0, 10.0, 3.0, 1.0])
    vector.grad = torch.tensor([1e3, -1.0, 1e-2, 4.0, -7.0])
    sign = vector.grad.sign()
    muon([matrix, vector], lr=2e-2, adamw_lr=5e-3).step()
    sizes = torch.linalg.svdvals(matrix.detach())
    assert float(sizes.max() / sizes.min()) < 2.5
    torch.testing.assert_close(vector.detach(), -5e-3 * sign, rtol=1e-4, atol=0)


def test_muon_decays_matrices_alone() -> None:
    matrix, vector = torch.nn.Parameter(torch.ones(4, 4)), torch.nn.Parameter(torch.ones(4))
    optimizer = muon([matrix, vector], lr=1e-2, weight_decay=0.5)
    matrix.grad, vector.grad = torch.zeros(4, 4), torch.zeros(4)
    optimizer.step()
    torch.testing.assert_close(matrix.detach(), torch.full((4, 4), 1 - 0.5 * 1e-2))
    assert torch.equal(vector.detach(), torch.ones(4))


@pytest.mark.parametrize("name", sorted(FACTORIES))
def test_every_optimizer_lowers_a_loss(make_module: MakeModule, name: str) -> None:
    module = make_module(method="sno")
    batch = random_batch(module.operator.game, 32)
    built = make_optimizer(name, 30, lr=3e-3, schedule="constant", final_lr=0.0)(module.operator.parameters())
    losses = []
    for step in range(30):
        built["optimizer"].zero_grad()
        loss = module.training_step(batch, step)
        loss.backward()
        built["optimizer"].step()
        losses.append(loss.item())
    assert losses[-1] < 0.98 * losses[0]


def test_norms_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match="huber, l1, l2"):
        Norm("l3")


@pytest.mark.parametrize("name", sorted(FACTORIES))
def test_unknown_optimizer_options_are_refused_before_training(name: str) -> None:
    with pytest.raises(KeyError, match="No option of"):
        make_optimizer(name, steps=3, lr=1e-3, schedule="constant", final_lr=0.0, foo=1)


@pytest.mark.parametrize(
    ("option", "near"), [("adam_lr", "adamw_lr"), ("momentun", "momentum"), ("weight_deca", "weight_decay")]
)
def test_options_of_muon_come_with_the_nearest(option: str, near: str) -> None:
    with pytest.raises(UnknownNameError, match=f"Did you mean '{near}'"):
        make_optimizer("muon", steps=3, lr=1e-3, schedule="constant", final_lr=0.0, **{option: 0.1})


@pytest.fixture
def logged(monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """What the latest training step logged."""
    content: dict[str, float] = {}
    monkeypatch.setattr(TrainingModule, "log", lambda self, name, value, **kwargs: content.update({name: float(value)}))
    monkeypatch.setattr(
        TrainingModule,
        "log_dict",
        lambda self, values, **kwargs: content.update({n: float(v) for n, v in values.items()}),
    )
    return content


def test_balanced_terms_begin_at_their_weights(make_module: MakeModule) -> None:
    """The first running mean of a term is the term itself."""
    batch = random_batch(make_module().operator.game)
    module = make_module(weights=ALL, balance=True)
    assert module.training_step(batch, 0).item() == pytest.approx(sum(ALL.values()))
    assert make_module(method="sno", balance=True).training_step(batch, 0).item() == pytest.approx(2)
    late = make_module(weights=ALL, balance=True)
    assert late.training_step({"bvp": batch["bvp"]}, 0).item() == pytest.approx(2)
    first = late.training_step(batch, 1).item()
    assert first == pytest.approx(2 + 0.1 + 0.1), "terms that join later begin at their weights too"


def test_a_balanced_term_is_divided_by_its_running_mean(make_module: MakeModule, logged: dict[str, float]) -> None:
    module = make_module(weights=ALL, balance=True)
    batches = [random_batch(module.operator.game, 8) for _ in range(4)]
    mean: dict[str, float] = {}
    for step, batch in enumerate(batches):
        total = module.training_step(batch, step).item()
        now = {name: logged[f"loss/{name}"] for name in ALL}
        mean = {name: 0.99 * mean.get(name, now[name]) + 0.01 * now[name] for name in ALL}
        assert total == pytest.approx(sum(ALL[name] * now[name] / mean[name] for name in ALL), rel=1e-5)
        assert logged["loss/total"] == pytest.approx(total)


def test_a_balanced_loss_has_the_gradient_of_the_log_loss(make_module: MakeModule) -> None:
    module, plain = make_module(weights=ALL, balance=True), make_module(weights=ALL)
    batch = random_batch(module.operator.game)
    slopes = torch.autograd.grad(module.training_step(batch, 0), list(module.operator.parameters()))
    logs = [ALL[name] * loss.log() for name, loss in plain.losses(batch).items()]
    expected = torch.autograd.grad(torch.stack(logs).sum(), list(plain.operator.parameters()))
    for found, slope in zip(slopes, expected, strict=True):
        torch.testing.assert_close(found, slope, rtol=1e-3, atol=1e-6)


def test_a_balanced_loss_does_not_depend_on_the_unit_of_a_term(make_module: MakeModule) -> None:
    totals = []
    for scaled in (True, False):
        module = make_module(method="sno", balance=True, scaled=scaled)
        torch.manual_seed(0)
        totals.append([module.training_step(random_batch(module.operator.game), step).item() for step in range(3)])
    assert totals[0] == pytest.approx(totals[1], rel=1e-4)


def test_a_balanced_term_that_vanishes_leaves_the_loss_finite(
    make_module: MakeModule, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Boundary, "residual", lambda self, view: 0 * view.field.value)
    module = make_module(weights=ALL, balance=True)
    batch = random_batch(module.operator.game)
    for step in range(2):
        loss = module.training_step(batch, step)
        loss.backward()
        assert loss.item() == pytest.approx(2.1, rel=0.2)
    assert all(bool(w.grad.isfinite().all()) for w in module.operator.parameters() if w.grad is not None)


def test_running_means_survive_a_checkpoint(make_module: MakeModule) -> None:
    whole = make_module(weights=ALL, balance=True)
    batches = [random_batch(whole.operator.game) for _ in range(3)]
    for step in range(2):
        whole.training_step(batches[step], step)
    resumed = make_module(weights=ALL, balance=True, seed=1)
    resumed.load_state_dict(whole.state_dict())
    assert bool((resumed.objective.running > 0).all())
    fresh = make_module(weights=ALL, balance=True)
    fresh.operator.load_state_dict(whole.operator.state_dict())
    totals = [module.training_step(batches[2], 2).item() for module in (whole, resumed, fresh)]
    assert totals[0] == totals[1]
    assert totals[0] != totals[2]


def test_means_run_only_where_they_are_asked_for(make_module: MakeModule) -> None:
    module = make_module(weights=ALL)
    module.training_step(random_batch(module.operator.game), 0)
    assert not module.objective.running.any()


def residuals(module: TrainingModule, batch: Batch) -> Tensor:
    """Residual of every player at every collocation point, in the unit of the loss, (B, P)."""
    points, operator, game = batch["interior"].points, module.operator, module.operator.game
    size = operator.value_scale / game.horizon + game.penalty(points.x, points.theta)
    with torch.no_grad():
        found = hji_residual(game, points, operator.field(points))
    return found / size if module.objective.scaled else found


@pytest.mark.parametrize("scaled", [True, False])
@pytest.mark.parametrize(("share", "count"), [(0.25, 3), (0.5, 6), (0.05, 1), (0.01, 1), (0.999, 12)])
@pytest.mark.parametrize("table", [True, False])
def test_only_the_hardest_points_count(
    make_module: MakeModule, scaled: bool, share: float, count: int, table: bool
) -> None:
    options = {"weights": {"value": 1.0, "residual": 0.5}, "scaled": scaled}
    module = make_module(hardest=share, **options).double()
    batch = random_batch(module.operator.game, 12)
    batch["interior"] = Sample(random_points(module.operator.game, 12, seed=11))
    if table:
        batch = {name: s._replace(types=distinct_types(s.points.theta)) for name, s in batch.items()}
    signed = residuals(module, batch)
    sizes = signed.abs().amax(-1)
    assert bool((signed.amax(-1) < sizes)[sizes.topk(2).indices].any()), "large negative ones count as well"
    hardest = sizes.argsort(descending=True)[:count]
    expected = make_module(**options).double().losses(batch | {"interior": batch["interior"].rows(hardest)})
    found = module.losses(batch)
    torch.testing.assert_close(found["residual"], expected["residual"], rtol=1e-12, atol=0)
    torch.testing.assert_close(found["value"], expected["value"], rtol=1e-12, atol=0)
    assert len(sizes.unique()) == 12
    easier = sizes.argsort(descending=True)[1 : count + 1]
    other = make_module(**options).double().losses(batch | {"interior": batch["interior"].rows(easier)})
    assert (found["residual"] - other["residual"]).abs() > 1e-9 or count == 12


def test_all_points_count_where_none_is_left_out(make_module: MakeModule, monkeypatch: pytest.MonkeyPatch) -> None:
    batch = random_batch(make_module().operator.game)
    every = make_module(weights=ALL).training_step(batch, 0)
    module = make_module(weights=ALL, hardest=1.0)

    def never(*arguments: object) -> None:
        raise AssertionError("rows were picked")

    monkeypatch.setattr(Sample, "rows", never)
    assert torch.equal(module.training_step(batch, 0), every)


def test_the_hardest_points_have_a_gradient(make_module: MakeModule) -> None:
    module = make_module(weights={"residual": 1.0}, hardest=0.25)
    module.training_step(random_batch(module.operator.game), 0).backward()
    assert bool(module.operator.networks[0].trunk.layers[0].weight.grad.any())


def test_only_collocation_points_are_left_out(make_module: MakeModule) -> None:
    batch = random_batch(make_module().operator.game)
    terms = {share: make_module(weights=ALL, hardest=share).losses(batch) for share in (1.0, 0.2)}
    for name in ("value", "costate", "boundary"):
        assert torch.equal(terms[1.0][name], terms[0.2][name])
    assert not torch.equal(terms[1.0]["residual"], terms[0.2]["residual"])
    sno = {share: make_module(method="sno", hardest=share).training_step(batch, 0) for share in (1.0, 0.2)}
    assert torch.equal(*sno.values())


@pytest.mark.parametrize("share", [0, 0.0, -0.5, 1.0001, 2, math.nan, math.inf])
def test_impossible_shares_of_points_are_refused(make_module: MakeModule, share: float) -> None:
    with pytest.raises(ValueError, match=r"loss.hardest is a share in \(0, 1\]"):
        make_module(hardest=share)
