"""Closed-loop validation, the best checkpoint and divergence, as a run of train.py meets them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from hno.control.rollout import Disturbance
from hno.data import GameData
from hno.data.certificates import safe
from hno.evaluation import closed_loop
from hno.training.module import TrainingModule
from hno.training.validation import ClosedLoopValidation, Later, Score
from hno.types import Batch, Extremal, Trajectory
from tests.cli.conftest import SMOKE, Command, Outcome, refused
from tests.cli.test_train import equal, power_cut, weights

EIGHT = (*SMOKE, "trainer.max_steps=8", "trainer.validate_every=2", "trainer.print_every=1")

Scores = Callable[[Mapping[int, Score]], None]


@pytest.fixture
def scores(monkeypatch: pytest.MonkeyPatch) -> Scores:
    """Let validations find chosen scores, by step."""

    def choose(chosen: Mapping[int, Score]) -> None:
        monkeypatch.setattr(ClosedLoopValidation, "play", lambda self, trainer, *_: chosen[trainer.global_step])

    return choose


def content(path: Path) -> dict[str, Any]:
    return torch.load(path, weights_only=True)


def test_results_and_table_are_those_of_the_best_checkpoint(command: Command, scores: Scores, tmp_path: Path) -> None:
    scores({2: Score(1.0, 0.3), 4: Score(0.25, 0.2), 6: Score(0.25, 0.4), 8: Score(0.5, 0.1)})
    run = command("train", *EIGHT)
    assert run.code == 0, run.text
    assert run.results["checkpoint"] == "best.ckpt"
    assert run.results["validation"] == {"collision_rate": 0.25, "excess": 0.2}
    assert content(run.folder / "best.ckpt")["global_step"] == 4
    assert content(run.folder / "last.ckpt")["global_step"] == run.results["steps"] == 8
    header, *rows = [line.split(",") for line in (run.folder / "csv" / "metrics.csv").read_text().splitlines()]
    column = header.index("closed_loop/collision_rate")
    assert [float(row[column]) for row in rows if row[column]][-1] == 0.5
    tables = []
    for name in ("best", "last"):
        again = command(
            "evaluate", f"checkpoint={run.folder}/{name}.ckpt", "theta=1,1", "workers=1", "starts=4", "dt=0.25",
            folder=tmp_path / name,
        )  # fmt: skip
        tables.append(again.results["table"])
    assert run.results["table"] == tables[0] != tables[1]


def test_validation_plays_the_safe_held_out_starts(
    command: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    given: list[list[Extremal]] = []
    held: list[list[Extremal]] = []
    begin, setup = ClosedLoopValidation.begin, GameData.setup

    def watched(self: ClosedLoopValidation, labels: list[Extremal], later: Later | None) -> None:
        given.append(labels)
        begin(self, labels, later)

    def prepared(self: GameData, stage: str) -> None:
        setup(self, stage)
        held.append(self.held_out())

    monkeypatch.setattr(ClosedLoopValidation, "begin", watched)
    monkeypatch.setattr(GameData, "setup", prepared)
    run = command("train", *SMOKE, "trainer.max_steps=2")
    assert run.code == 0, run.text
    ((labels,),) = given
    assert torch.equal(labels.x, held[0][0].x)
    assert bool(safe(labels).all())
    assert "validation_labels" not in run.results["seconds"]
    rest = command("train", *SMOKE, "trainer.max_steps=2", "evaluation.clearance=50", folder=tmp_path / "rest")
    assert given[1] == []
    assert "there is no closed-loop validation" in rest.text
    assert rest.results["checkpoint"] == "last.ckpt"


@pytest.mark.slow
def test_validation_starts_of_chosen_types(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[list[Extremal]] = []
    begin = ClosedLoopValidation.begin

    def watched(self: ClosedLoopValidation, labels: list[Extremal], later: Later | None) -> None:
        given.append(labels)
        begin(self, labels, later)

    monkeypatch.setattr(ClosedLoopValidation, "begin", watched)
    run = command("train", *SMOKE, "trainer.max_steps=2", "validation.types='1,1;2,3'", "validation.starts=2")
    assert run.code == 0, run.text
    assert [(labels.theta[0].tolist(), len(labels.status)) for labels in given[0]] == [([1, 1], 2), ([2, 3], 2)]
    assert all(bool(safe(labels).all()) for labels in given[0])
    assert run.results["seconds"]["validation_labels"] >= 0
    assert run.results["checkpoint"] == "best.ckpt"


@pytest.mark.usefixtures("no_labels")
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ("validation.types=grid",),
            "validation.types must be one of corners, gridN (as in grid5), or a list such as '1,1;2.5,4'; got 'grid'",
        ),
        (("validation.types=default",), "validation.types must be one of corners, gridN"),
        (("validation.types='1,1;2'",), "2 finite numbers, one per player; got [2.0]"),
        (("validation.types='1,nan'",), "2 finite numbers"),
        (("validation.types='1,inf'",), "2 finite numbers"),
        (("validation.types=''",), "validation.types must be one of corners, gridN"),
        (("validation.types=5",), "2 finite numbers, one per player; got [5.0]"),
        (("validation.types=[[1,1,1]]",), "2 finite numbers, one per player; got [1, 1, 1]"),
        (
            ("validation.types=grid5", "validation.starts=0"),
            "validation.starts must be greater than or equal to 1; got 0",
        ),
        (
            ("validation=grid5", "validation.starts=-2"),
            "validation.starts must be greater than or equal to 1; got -2",
        ),
        (("validation=grid5", "validation.starts=many"), "validation.starts must be a valid integer; got 'many'"),
        (("validation=grid7",), "Did you mean 'grid5'?"),
        (("validation.stop=true",), "Known: clearance, dt, seed, starts, stop_when_safe, types"),
        (("loss.hardest=0",), "loss.hardest must be greater than 0; got 0"),
        (("loss.hardest=1.5",), "loss.hardest must be less than or equal to 1; got 1.5"),
        (("sampler.rollout=-1",), "sampler.rollout.share must be greater than or equal to 0; got"),
        (("sampler=roll-out",), "Did you mean 'rollout'?"),
        (("optimizer=moun",), "Did you mean 'muon'?"),
        (("optimizer.schedule=liner",), "Did you mean 'linear'?"),
        (("optimizer=muon", "+optimizer.adam_lr=1"), "Did you mean 'adamw_lr'?"),
        (("evaluation.noise=-1",), "noise must be"),
        (("evaluation.noise=nan",), "noise must be"),
        (("evaluation.delay=-1",), "delay must be"),
        (("evaluation.delay=0.5",), "delay must be"),
        (("evaluation.widen=0",), "widen must be"),
        (("evaluation.safe=maybe",), "safe must be a valid boolean"),
    ],
)
def test_bad_input_is_answered_before_any_label_is_solved(
    command: Command, overrides: tuple[str, ...], message: str
) -> None:
    refused(command("train", *SMOKE, *overrides), message)


@pytest.mark.parametrize("stop", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_run_ends_once_it_is_safe_if_asked(command: Command, scores: Scores, stop: bool) -> None:
    scores({2: Score(0.5, 0.3), 4: Score(0.0, 0.2), 6: Score(0.0, 0.3), 8: Score(0.1, 0.0)})
    run = command("train", *EIGHT, f"validation.stop_when_safe={str(stop).lower()}")
    assert run.code == 0, run.text
    assert run.results["status"] == "finished"
    assert run.results["steps"] == (4 if stop else 8)
    assert content(run.folder / "last.ckpt")["global_step"] == run.results["steps"]
    assert content(run.folder / "best.ckpt")["global_step"] == 4
    assert ("step 5 of 8" in run.text) == (not stop)


def poisoned(monkeypatch: pytest.MonkeyPatch, step: int) -> None:
    """Let the loss be NaN from a step on."""
    original = TrainingModule.training_step

    def training_step(self: TrainingModule, batch: Batch, batch_idx: int) -> Tensor:
        loss = original(self, batch, batch_idx)
        return loss * torch.nan if self.global_step >= step else loss

    monkeypatch.setattr(TrainingModule, "training_step", training_step)


def diverged(run: Outcome, *fragments: str) -> None:
    refused(run, "the training diverged", "Lower optimizer.lr or set trainer.gradient_clip_val", *fragments)
    assert run.results["status"] == "failed"
    assert run.results["reason"].startswith("DivergedError: ")
    for fragment in fragments:
        assert fragment in run.results["reason"]


def test_a_diverged_run_names_its_last_good_checkpoint(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    poisoned(monkeypatch, 5)
    run = command("train", *EIGHT)
    diverged(run, "The loss is nan at step 6")
    assert f"The last good checkpoint is {run.folder / 'last.ckpt'}." in run.text
    assert (run.folder / "bad_batch.safetensors").exists()
    assert run.results["checkpoint"] == "best.ckpt"
    assert content(run.folder / "last.ckpt")["global_step"] == 5
    assert content(run.folder / "best.ckpt")["global_step"] in (2, 4)
    for path in run.folder.glob("*.ckpt"):
        assert all(bool(part.isfinite().all()) for part in content(path)["state_dict"].values())


def test_a_run_that_diverged_at_once_names_no_checkpoint(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    poisoned(monkeypatch, 0)
    run = command("train", *EIGHT, "optimizer=adam")
    diverged(run, "The loss is nan at step 1")
    assert "last good checkpoint" not in run.text
    assert "checkpoint" not in run.results
    assert not list(run.folder.glob("*.ckpt"))


def test_an_optimiser_that_cannot_go_on_is_divergence(command: Command) -> None:
    """SOAP factorises products of gradients, which may fail although all of them are finite."""
    run = command("train", *EIGHT, "loss.weights.value=1e25", "loss.norm=l2", "loss.scaled=false")
    diverged(run, "The optimiser failed at step 1")


def test_another_failure_names_no_checkpoint(command: Command) -> None:
    with power_cut(RuntimeError("power cut")):
        run = command("train", *EIGHT)
    assert run.code == 1
    assert (run.folder / "best.ckpt").exists()
    assert "last good checkpoint" not in run.text


def test_an_error_that_explodes_is_divergence(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    """Finite losses, but weights that went far away between two validations."""
    original = TrainingModule.training_step

    def training_step(self: TrainingModule, batch: Batch, batch_idx: int) -> Tensor:
        if self.global_step == 3:
            with torch.no_grad():
                self.operator.networks[0].branch.layers[-1].weight.mul_(1e4)
        return original(self, batch, batch_idx)

    monkeypatch.setattr(TrainingModule, "training_step", training_step)
    run = command("train", *EIGHT)
    diverged(run, "The error of costates is ", " at step 4; it was ")
    assert run.results["checkpoint"] == "best.ckpt"


@pytest.mark.slow
def test_the_best_checkpoint_of_an_earlier_run_in_the_folder_is_not_ours(command: Command) -> None:
    assert command("train", *SMOKE, "trainer.max_steps=2").code == 0
    run = command("train", *SMOKE, "trainer.max_steps=3", "seed=7", "evaluation.clearance=50")
    assert content(run.folder / run.results["checkpoint"])["global_step"] == 3


def test_the_best_checkpoint_goes_along_with_a_resumed_run(command: Command, scores: Scores, tmp_path: Path) -> None:
    scores({2: Score(0.0, 0.1), 4: Score(1.0, 0.0), 6: Score(0.5, 0.0), 8: Score(0.5, 0.0)})
    with power_cut(RuntimeError("power cut")):
        cut = command("train", *EIGHT, folder=tmp_path / "cut")
    kept = (cut.folder / "best.ckpt").read_bytes()
    resumed = command("train", *EIGHT, f"resume={cut.folder}/last.ckpt", folder=tmp_path / "resumed")
    assert resumed.code == 0, resumed.text
    assert content(resumed.folder / "best.ckpt")["global_step"] == 2
    assert resumed.results["checkpoint"] == "best.ckpt"
    assert (cut.folder / "best.ckpt").read_bytes() == kept
    (cut.folder / "best.ckpt").unlink()
    alone = command("train", *EIGHT, f"resume={cut.folder}/last.ckpt", folder=tmp_path / "alone")
    assert content(alone.folder / "best.ckpt")["global_step"] == 8


ROLLOUT = ("sampler=rollout", "data.pretrain=0")
ALL_ELSE = (
    "loss.balance=true", "loss.hardest=0.5", "function.exact_terminal=true", "optimizer=muon",
    "optimizer.schedule=linear",
)  # fmt: skip


@pytest.mark.parametrize(
    "recipe",
    [
        pytest.param(ROLLOUT, id="rollout states", marks=pytest.mark.slow),
        pytest.param(ALL_ELSE, id="all else", marks=pytest.mark.slow),
    ],
)
def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(
    command: Command, tmp_path: Path, recipe: tuple[str, ...]
) -> None:
    overrides = (*EIGHT, *recipe)
    whole = command("train", *overrides, folder=tmp_path / "whole")
    with power_cut(RuntimeError("power cut")):
        cut = command("train", *overrides, folder=tmp_path / "cut")
    assert (whole.code, cut.code) == (0, 1), whole.text
    assert content(cut.folder / "last.ckpt")["global_step"] == 4
    resumed = command("train", *overrides, f"resume={cut.folder}/last.ckpt", folder=tmp_path / "resumed")
    assert resumed.code == 0, resumed.text
    assert equal(weights(resumed.folder), weights(whole.folder))
    assert not equal(weights(resumed.folder), weights(cut.folder))
    assert resumed.results["table"] == whole.results["table"]
    best = [content(run.folder / "best.ckpt") for run in (whole, resumed)]
    assert equal(best[0]["state_dict"], best[1]["state_dict"])
    assert best[0]["global_step"] == best[1]["global_step"]


def test_rollout_states_are_those_of_the_policy(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    """Validations tell the data; checkpoints carry what they told."""
    told: list[Tensor] = []
    visit = GameData.visit

    def watched(self: GameData, played: Trajectory, step: int) -> None:
        told.append(played.x)
        visit(self, played, step)

    monkeypatch.setattr(GameData, "visit", watched)
    run = command("train", *EIGHT, "sampler=rollout")
    assert run.code == 0, run.text
    assert len(told) == 4
    assert not torch.equal(told[0], told[-1])
    kept = content(run.folder / "last.ckpt")["GameData"]["visits"][-1]
    assert torch.equal(kept["x"], told[-1].flatten(0, 1))


def test_polishing_is_part_of_the_run(command: Command, tmp_path: Path) -> None:
    plain = command("train", *SMOKE, "trainer.max_steps=4", folder=tmp_path / "plain")
    run = command(
        "train", *SMOKE, "data.finish=0", "trainer.max_steps=4", "trainer.polish=5", folder=tmp_path / "polished"
    )
    assert run.code == 0, run.text
    assert "L-BFGS: loss " in run.text
    after, before = (float(word) for word in run.text.split("L-BFGS: loss ")[1].split("\n")[0].split(", was "))
    assert after < before
    assert not equal(weights(run.folder), weights(plain.folder))
    assert "L-BFGS" not in plain.text


@pytest.mark.parametrize("name", ["train", "evaluate"])
def test_disturbances_reach_the_table(
    command: Command, monkeypatch: pytest.MonkeyPatch, random_checkpoint: Path, name: str
) -> None:
    seen: list[Disturbance] = []
    original = closed_loop.rollout

    def watched(*arguments: Any, disturbance: Disturbance, **options: Any) -> Trajectory:
        seen.append(disturbance)
        return original(*arguments, disturbance=disturbance, **options)

    monkeypatch.setattr(closed_loop, "rollout", watched)
    if name == "train":
        run = command("train", *SMOKE, "trainer.max_steps=1", "evaluation.noise=0.1", "evaluation.delay=2")
    else:
        run = command(
            "evaluate", f"checkpoint={random_checkpoint}", "theta=1,1", "workers=1", "starts=4", "dt=0.25", "noise=0.1",
            "delay=2",
        )  # fmt: skip
    assert run.code == 0, run.text
    assert [(disturbance.noise, disturbance.delay) for disturbance in seen] == [(0.1, 2)]
    assert (run.results["noise"], run.results["delay"]) == (0.1, 2)


def test_safe_starts_by_number(command: Command, random_checkpoint: Path) -> None:
    run = command(
        "evaluate", f"checkpoint={random_checkpoint}", "theta=1,1", "workers=1", "starts=3", "dt=0.25", "safe=true"
    )
    assert run.code == 0, run.text
    (row,) = run.results["table"]
    assert row["safe_starts"] == 3
    assert row["starts"] >= 3
