"""Training as a library call."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import lightning as L
import pytest
import torch
from torch import Tensor

from hno.data import Collocation, GameData, LabelPlan, make_sampler
from hno.data import datamodule as data_module
from hno.data.curriculum import Curriculum
from hno.games import make
from hno.losses import LossTerm, Objective, View, make_objective
from hno.operators import Choice, ValueOperator
from hno.operators import make_operator as built
from hno.processes import stop_if_asked
from hno.training import Fitted, Settings, fit
from hno.training.checkpoint import Provenance, load_operator, record
from hno.training.fit import LAST
from hno.training.validation import BEST
from tests.fakes import fake_labels
from tests.operators.conftest import architecture, random_points, small_operator

TYPES = [(1.0, 1.0), (1.0, 5.0)]
WEIGHTS = {"value": 1.0, "costate": 1.0, "residual": 0.1, "boundary": 0.1}
STEPS, EVERY = 8, 4


def settings(**changes: Any) -> Settings:
    optimizer = {"name": "soap", "lr": 1e-2}
    usual = {"steps": STEPS, "validate_every": EVERY, "accelerator": "cpu", "optimizer": optimizer, "dt": 0.2}
    return Settings(**(usual | changes))


def labelled_data(
    seed: int = 0, sampler: Mapping[str, float] = {"box": 0.5, "rollout": 0.5}, *, potential: bool = False
) -> GameData:
    """Every stream, on labels that were not solved; what validation visits is drawn from.

    Where a potential is learned, the first start of each type has two equilibria.
    """
    game, plan = make("narrow_road"), LabelPlan(types=TYPES, trajectories=3, validation=1, cache=Path("unused"))
    collocation = Collocation(make_sampler(sampler), Curriculum(2, 3))
    sizes = {"bvp": 16, "interior": 16, "terminal": 4}
    streams = {"bvp", "interior", "terminal"}
    data = GameData(game, streams, seed, plan, collocation, sizes, potential=potential)
    data.extremals = [fake_labels(game, theta, 5 if potential else 4, seed=row) for row, theta in enumerate(TYPES)]
    if potential:
        start = torch.tensor([0, 0, 1, 2, 3])
        data.extremals = [found._replace(start=start) for found in data.extremals]
    return data


def trained(
    folder: Path, seed: int = 0, operator: ValueOperator | None = None, resume: Path | None = None, **changes: Any
) -> tuple[ValueOperator, Fitted]:
    callbacks = changes.pop("callbacks", [])
    operator = operator or small_operator(seed=seed)
    weights = WEIGHTS | ({"branches": 1.0} if operator.potential else {})
    objective = make_objective({name: {} for name in weights}, weights, balance=True)
    data = labelled_data(potential=operator.potential)
    found = fit(operator, objective, data, settings(**changes), folder, resume=resume, callbacks=callbacks)
    return operator, found


def test_a_training_prints_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("DEBUG"):
        trained(tmp_path)
    assert tuple(capfd.readouterr()) == ("", "")
    assert [line.message for line in caplog.records if line.name.startswith("lightning")] == []


POTENTIAL = replace(architecture(), function=Choice("potential", {"exact_terminal": False}))


def potential_operator(seed: int = 0) -> ValueOperator:
    """A small operator of a potential."""
    torch.manual_seed(seed)
    return built(make("narrow_road"), POTENTIAL)


def equal(one: ValueOperator, other: ValueOperator) -> bool:
    return all(torch.equal(a, b) for a, b in zip(one.state_dict().values(), other.state_dict().values(), strict=True))


def test_the_same_seed_gives_the_same_operator(tmp_path: Path) -> None:
    torch.manual_seed(5)
    first, found = trained(tmp_path / "first")
    torch.manual_seed(6)
    second, again = trained(tmp_path / "second")
    assert equal(first, second)
    assert found.metrics == again.metrics
    assert found.best == again.best
    other, _ = trained(tmp_path / "other", seed=1)
    assert not equal(first, other)
    assert not equal(first, small_operator())


class PowerCutError(Exception):
    """The machine is gone."""


class PowerCut(L.Callback):
    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        if trainer.global_step == EVERY + 2:
            raise PowerCutError


@pytest.mark.parametrize("make_operator", [lambda seed: small_operator(seed=seed), potential_operator], ids=["V", "W"])
@pytest.mark.parametrize("name", ["soap", "adam"])
def test_a_resumed_run_is_the_uninterrupted_one_bit_by_bit(
    tmp_path: Path, name: str, make_operator: Callable[[int], ValueOperator]
) -> None:
    optimizer = {"name": name, "lr": 1e-2}
    whole, found = trained(tmp_path / "whole", operator=make_operator(0), optimizer=optimizer)
    with pytest.raises(PowerCutError):
        trained(tmp_path / "cut", operator=make_operator(0), optimizer=optimizer, callbacks=[PowerCut()])
    torch.manual_seed(7)
    cut = tmp_path / "cut"
    resumed, again = trained(cut, operator=make_operator(3), resume=cut / LAST, optimizer=optimizer)
    assert again.trainer.global_step == STEPS
    assert equal(whole, resumed)
    assert found.metrics == again.metrics
    assert found.best == again.best


@pytest.mark.parametrize("potential", [True, False])
def test_an_operator_and_data_that_learn_different_things_are_refused(tmp_path: Path, potential: bool) -> None:
    operator, data = potential_operator() if potential else small_operator(), labelled_data(potential=not potential)
    learned = {True: "a potential", False: "the players' values"}
    wanted = (
        f"The operator learns {learned[potential]}, the data label {learned[not potential]}: .*"
        r"GameData\(potential=operator\.potential\)"
    )
    with pytest.raises(ValueError, match=wanted):
        fit(operator, make_objective({"value": {}}, {"value": 1.0}), data, settings(), tmp_path)
    assert not list(tmp_path.iterdir())


def test_an_operator_of_a_potential_learns_from_all_equilibria(tmp_path: Path) -> None:
    """All terms are in the loss, which falls, and only branches that a label has are played afterwards."""
    losses: list[float] = []

    class Watch(L.Callback):
        def on_train_batch_end(self, trainer: L.Trainer, pl_module: Any, outputs: Any, *others: object) -> None:
            losses.append(float(outputs["loss"]))

    weights = {"value": 1.0, "costate": 1.0, "branches": 1.0}
    operator, data = potential_operator(), labelled_data(potential=True)
    objective = make_objective({name: {} for name in weights}, weights)
    found = fit(operator, objective, data, settings(steps=60), tmp_path, callbacks=[Watch()], validation=[])
    assert {f"loss/{name}" for name in (*weights, "total")} <= found.metrics.keys()
    assert {"val/value_error", "val/costate_error"} <= found.metrics.keys()
    assert sum(losses[-5:]) < 0.9 * sum(losses[:5])
    assert torch.equal(operator.value_scale, data.scales()[0])
    assert data.train_rows is not None
    assert operator.active.nonzero().squeeze(-1).tolist() == data.train_rows.types.branch.unique().tolist()


def test_branches_that_no_label_has_are_closed_by_a_training(tmp_path: Path) -> None:
    """Labels in which nobody moves sideways: seen from player 1, player 2 turns one way in all of them, or in none."""
    operator, data = potential_operator(), labelled_data(potential=True)
    still = [found._replace(x=found.x[:1, :1].expand_as(found.x).contiguous()) for found in data.extremals]
    data.extremals = still
    objective = make_objective({"value": {}}, {"value": 1.0})
    entries = record(operator.game, POTENTIAL, Provenance("mine", TYPES))
    found = fit(operator, objective, data, settings(steps=1), tmp_path, validation=[], record=entries)
    assert operator.active.tolist() == [True, False]
    loaded, _, _ = load_operator(found.checkpoint)
    assert loaded.active.tolist() == [True, False]
    points = random_points(operator.game)
    assert all(map(torch.equal, loaded.field(points), operator.field(points)))


def test_what_comes_back_is_the_best_or_the_last_checkpoint(tmp_path: Path) -> None:
    operator, found = trained(tmp_path)
    assert found.best is not None
    assert found.checkpoint == tmp_path / BEST
    assert {f"loss/{name}" for name in (*WEIGHTS, "total")} <= found.metrics.keys()
    assert {"val/value_error", "val/costate_error"} <= found.metrics.keys()
    assert min(found.seconds.values()) > 0
    objective = make_objective({"value": {}}, {"value": 1.0})
    data, folder = labelled_data(), tmp_path / "none"
    folder.mkdir()
    shutil.copy(tmp_path / BEST, folder / BEST)  # of another run
    entries = record(operator.game, architecture(), Provenance("mine", TYPES))
    found = fit(operator, objective, data, settings(), folder, validation=[], record=entries)
    assert (found.best, found.checkpoint) == (None, folder / LAST)
    assert data.between is stop_if_asked, "batches that are drawn later save nothing in its folder"
    points = random_points(operator.game)
    loaded, _, origin = load_operator(found.checkpoint)
    assert all(map(torch.equal, loaded.field(points), operator.field(points)))
    assert origin == Provenance("mine", TYPES)


@pytest.mark.parametrize("scaled", [True, False])
def test_scales_are_those_of_the_labels_where_residuals_are_scaled(tmp_path: Path, scaled: bool) -> None:
    operator, data = small_operator(), labelled_data()
    objective = make_objective({"value": {}}, {"value": 1.0}, scaled=scaled)
    fit(operator, objective, data, settings(steps=1), tmp_path, validation=[])
    value, costate = data.scales() if scaled else small_operator().scales
    assert torch.equal(operator.value_scale, value)
    assert torch.equal(operator.costate_scale, costate)


class Clock(LossTerm):
    """Values, and a diary of the steps at which it was asked."""

    stream = "bvp"

    def __init__(self) -> None:
        super().__init__()
        self.steps: list[int] = []

    def residual(self, view: View) -> Tensor:
        self.steps.append(view.step)
        return view.field.value - view.at(view.sample.points).value.detach() + 1

    def scale(self, view: View) -> Tensor:
        return view.scales.value


def test_a_term_sees_the_step_and_the_operator_anywhere(tmp_path: Path) -> None:
    """`at` is the operator at points of its choice: at the sample's own, values differ by nothing."""
    clock, data = Clock(), labelled_data()
    operator = small_operator(exact_terminal=True)
    found = fit(operator, Objective({"clock": clock}, {"clock": 1.0}), data, settings(steps=5), tmp_path, validation=[])
    assert clock.steps == [0, 1, 2, 3, 4]
    assert found.metrics["loss/clock"] == pytest.approx(1 / float(operator.value_scale), rel=1e-4)


@pytest.mark.parametrize("sampler", [{"box": 0.4, "band": 0.6}, {"rollout": 1.0}])
@pytest.mark.parametrize("exact", [True, False])
def test_physics_alone_trains_without_a_label(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, sampler: Mapping[str, float], exact: bool
) -> None:
    def fail(*arguments: object) -> None:
        raise AssertionError("labels were solved")

    monkeypatch.setattr(data_module, "labels_for", fail)
    weights = {"residual": 1.0, "boundary": 1.0}
    objective = make_objective({name: {} for name in weights}, weights)
    operator = small_operator(exact_terminal=exact)
    streams = objective.streams(exact_terminal=exact)
    plan, where = LabelPlan(types=TYPES, cache=Path("unused")), Collocation(make_sampler(sampler))
    data = GameData(make("narrow_road"), streams, 0, plan, where, {"bvp": 8, "interior": 64, "terminal": 16})
    losses: list[float] = []

    class Watch(L.Callback):
        def on_train_batch_end(self, trainer: L.Trainer, pl_module: Any, outputs: Any, *others: object) -> None:
            losses.append(float(outputs["loss"]))

    found = fit(operator, objective, data, settings(steps=30, polish=2), tmp_path, callbacks=[Watch()])
    assert (found.best, found.checkpoint) == (None, tmp_path / LAST)
    assert not any(name.startswith("val/") for name in found.metrics)
    assert bool((operator.value_scale > 0) & (operator.costate_scale > 0).all())
    assert len(losses) == 30
    assert sum(losses[-5:]) < 0.9 * sum(losses[:5])
