from __future__ import annotations

import csv
import itertools
import json
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import hno
from hno.cli import evaluate, train
from hno.cli.media import draw_typical
from hno.cli.results import Results
from hno.data.labels import Request
from hno.evaluation import outcome
from hno.evaluation.closed_loop import TypeRow
from hno.games import Game
from hno.operators.deeponet import DeepONet
from hno.training import validation
from hno.training.divergence import StopOnDivergence
from hno.training.module import TrainingModule
from hno.training.validation import Score, Starts
from hno.types import Extremal, Trajectory
from tests.cli.conftest import SMOKE, Command, Outcome
from tests.fakes import fake_labels

GAMES, OPERATORS, ACTIVATIONS = ("narrow_road", "lane_change", "drone"), ("hno", "sno"), ("tanh", "sin", "relu")
FAST = {("narrow_road", "sno", "sin"), ("narrow_road", "hno", "sin"), ("drone", "hno", "sin")}
KEYS = {
    "status", "reason", "game", "operator", "activation", "seed", "steps", "training_hash", "seconds", "table",
    "versions", "config", "episodes",
}  # fmt: skip
"""Entries of results.json that are there however a run ends."""


def weights(folder: Path) -> dict[str, Tensor]:
    return torch.load(folder / "last.ckpt", weights_only=True)["state_dict"]


def equal(one: dict[str, Tensor], other: dict[str, Tensor]) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


def losses(folder: Path) -> list[dict[str, str]]:
    with (folder / "csv" / "metrics.csv").open() as file:
        return [row for row in csv.DictReader(file) if row.get("loss/total")]


@pytest.mark.parametrize(
    ("game", "operator", "activation", "function"),
    [
        *(
            pytest.param(*parts, "potential", marks=() if parts in FAST else pytest.mark.slow)
            for parts in itertools.product(GAMES, OPERATORS, ACTIVATIONS)
        ),
        ("narrow_road", "hno", "sin", "value"),
        *(pytest.param(game, "hno", "sin", "value", marks=pytest.mark.slow) for game in GAMES[1:]),
    ],
)
def test_five_steps(command: Command, game: str, operator: str, activation: str, function: str) -> None:
    chosen = {"game": game, "operator": operator, "activation": activation, "function": function}
    run = command("train", *SMOKE, *(f"{name}={part}" for name, part in chosen.items()), "trainer.max_steps=5")
    assert run.code == 0, run.text
    results = run.results
    assert {name: results[name] for name in chosen} == chosen
    assert (results["status"], results["reason"], results["steps"]) == ("finished", None, 5)
    policy = hno.load_policy(run.folder / "last.ckpt")
    x = policy.game.initial_box.sample(3, torch.Generator().manual_seed(0))
    u = policy(torch.full((3,), policy.game.horizon), x, torch.full((3, 2), 2.5))
    assert u.shape == (3, 2, policy.game.control_dim)
    assert bool(u.isfinite().all())
    members = [part for part in policy.operator.modules() if isinstance(part, DeepONet)]
    slopes = [float(net.activation.slope) for member in members for net in (member.trunk, member.branch)]
    assert all(abs(slope - 0.1) > 1e-6 for slope in slopes)
    assert len(set(slopes)) == len(slopes) == 2


@pytest.mark.parametrize(("finish", "hybrid"), [(0, [2, 3, 4]), (0.4, [2]), (1, [])])
def test_collocation_comes_between_the_supervised_phases(command: Command, finish: float, hybrid: list[int]) -> None:
    """Of five steps, two are supervised only; then the residual joins, and what is logged ends with it."""
    phases = "data.pretrain=0.4", f"data.finish={finish}", "function.exact_terminal=false"
    run = command("train", *SMOKE, *phases, "trainer.max_steps=5", "trainer.print_every=1")
    lines = [line for line in run.text.splitlines() if "step " in line and " of 5:" in line]
    for term in ("loss/residual", "loss/boundary"):
        assert [step for step, line in enumerate(lines) if term in line] == hybrid
        assert (term in run.results["metrics"]) == (4 in hybrid)
    assert all("loss/value" in line for line in lines)


def test_results_hold_every_part_of_the_run(command: Command) -> None:
    run = command("train", *SMOKE, "trainer.max_steps=4")
    results = run.results
    assert results.keys() >= KEYS | {"checkpoint", "metrics", "clearance", "dt", "test_seed"}
    assert results["seconds"].keys() == {"labels", "training", "validation", "test_labels", "evaluation"}
    assert all(seconds >= 0 for seconds in results["seconds"].values())
    assert results["versions"].keys() >= {"hno", "python", "torch", "lightning"}
    assert set(results["metrics"]) >= {"loss/total", "val/value_error", "val/costate_error"}
    (row,) = results["table"]
    assert row.keys() == {*TypeRow._fields, *outcome.Outcome._fields} - {"outcome"}
    (labels,) = results["label_statistics"]
    assert (labels["theta"], labels["starts"]) == ([1, 1], 4)
    assert sum(labels["status"].values()) == 4
    assert results["config"]["trainer"]["max_steps"] == 4
    kept = json.loads((run.folder / results["episodes"]).read_text())
    assert {episode["kind"] for episode in kept["episodes"]} == {"worst", "typical"}
    assert row["theta"] == [1.0, 1.0]
    assert row["seen"]
    assert row["starts"] == 4
    assert row["unsolved"] + row["inevitable"] + row["marginal"] + row["safe_starts"] == 4
    assert (run.folder / results["checkpoint"]).is_file()


def test_run_says_what_happened(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    def warning(self: TrainingModule) -> None:
        logging.getLogger("lightning.pytorch.trainer").warning("a rank is gone")

    monkeypatch.setattr(TrainingModule, "on_train_start", warning, raising=False)
    run = command("train", *SMOKE, "trainer.max_steps=4", "trainer.print_every=2")
    assert "step 2 of 4" in run.text
    assert "narrow_road / hno / potential / sin" in run.text
    assert str(run.folder / "results.json") in run.text.replace("\n", "")
    log = (run.folder / "train.log").read_text()
    assert "step 4 of 4" in log
    assert "GPU available" not in run.text + log, "Lightning speaks of what goes wrong only"
    assert "[lightning.pytorch.trainer][WARNING] - a rank is gone" in log


@pytest.mark.parametrize(("steps", "every"), [(1, 5), (5, 2), (4, 2)])
def test_last_checkpoint_is_that_of_the_last_step(command: Command, steps: int, every: int) -> None:
    run = command("train", *SMOKE, f"trainer.max_steps={steps}", f"trainer.validate_every={every}")
    assert run.code == 0, run.text
    assert torch.load(run.folder / "last.ckpt", weights_only=True)["global_step"] == steps
    kept = ["best.ckpt", "last.ckpt"] + ["previous.ckpt"] * (steps > every)
    assert sorted(path.name for path in run.folder.glob("*.ckpt")) == kept


def test_run_leaves_a_picture_of_an_episode(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluate, "draw_typical", draw_typical)
    run = command("train", *SMOKE, "trainer.max_steps=1")
    assert (run.folder / "rollout.png").read_bytes().startswith(b"\x89PNG")


def test_label_sizes_are_the_scales_of_the_network(command: Command) -> None:
    scaled = command("train", *SMOKE, "trainer.max_steps=1")
    assert float(weights(scaled.folder)["operator.value_scale"]) > 1
    physical = command("train", *SMOKE, "trainer.max_steps=1", "loss.scaled=false")
    assert float(weights(physical.folder)["operator.value_scale"]) == 1


SIX = (*SMOKE, "trainer.max_steps=6", "trainer.validate_every=3", "trainer.print_every=1")


@contextmanager
def power_cut(error: BaseException) -> Iterator[None]:
    """Let trainings end with an error in step 5."""

    def cut(self: StopOnDivergence, trainer: Any, *others: Any) -> None:
        if trainer.global_step == 5:
            raise error

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StopOnDivergence, "on_train_batch_end", cut)
        yield


@pytest.mark.parametrize("optimizer", ["soap", pytest.param("adam", marks=pytest.mark.slow)])
def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(
    command: Command, tmp_path: Path, optimizer: str
) -> None:
    recipe = (*SIX, f"optimizer={optimizer}")
    whole = command("train", *recipe, folder=tmp_path / "whole")
    with power_cut(RuntimeError("power cut")):
        cut = command("train", *recipe, folder=tmp_path / "cut")
    assert (whole.code, cut.code) == (0, 1)
    kept = (cut.folder / "last.ckpt").read_bytes()
    assert torch.load(cut.folder / "last.ckpt", weights_only=True)["global_step"] == 3
    resumed = command("train", *recipe, f"resume={cut.folder}/last.ckpt", folder=tmp_path / "resumed")
    assert resumed.code == 0, resumed.text
    assert [f"step {step} of 6" in resumed.text for step in range(1, 7)] == [False] * 3 + [True] * 3
    assert equal(weights(resumed.folder), weights(whole.folder))
    assert not equal(weights(resumed.folder), weights(cut.folder))
    assert (cut.folder / "last.ckpt").read_bytes() == kept
    assert resumed.results["steps"] == 6
    assert resumed.results["table"] == whole.results["table"]


def test_failure_in_training_is_in_the_results(command: Command) -> None:
    with power_cut(RuntimeError("power cut")):
        run = command("train", *SIX)
    assert run.code == 1
    assert "power cut" in run.text
    assert "Traceback" in run.text  # nobody raised it on purpose, so where it came from matters
    results = run.results
    assert results.keys() >= KEYS
    assert (results["status"], results["reason"]) == ("failed", "RuntimeError: power cut")
    assert results["table"] == []
    assert "labels" in results["seconds"]


def test_an_interrupted_run_says_so(command: Command) -> None:
    with power_cut(KeyboardInterrupt()):
        run = command("train", *SIX)
    assert run.code != 0
    assert (run.results["status"], run.results["reason"]) == ("interrupted", "SIGINT")


@pytest.mark.parametrize(
    "activation", ["sin", *(pytest.param(name, marks=pytest.mark.slow) for name in ("tanh", "relu"))]
)
def test_same_seed_same_weights(command: Command, tmp_path: Path, activation: str) -> None:
    recipe = (*SMOKE, "trainer.max_steps=4", f"activation={activation}")
    first = command("train", *recipe, folder=tmp_path / "first")
    torch.rand(7)
    again = command("train", *recipe, folder=tmp_path / "again")
    assert equal(weights(first.folder), weights(again.folder))
    assert first.results["table"] == again.results["table"]
    assert first.results["training_hash"] == again.results["training_hash"]


@pytest.mark.slow
def test_other_seed_other_weights(command: Command, tmp_path: Path) -> None:
    first = command("train", *SMOKE, "trainer.max_steps=2", folder=tmp_path / "first")
    other = command("train", *SMOKE, "trainer.max_steps=2", "seed=1", folder=tmp_path / "other")
    assert not equal(weights(first.folder), weights(other.folder))


@pytest.mark.parametrize(
    "overrides", [("optimizer.lr=1e30",), ("optimizer=adam", "optimizer.lr=1e30", "activation=relu")]
)
def test_divergence_is_a_failure_with_a_reason(command: Command, overrides: tuple[str, ...]) -> None:
    run = command("train", *SMOKE, *overrides)
    assert run.code == 1
    assert "the training diverged" in run.text
    results = run.results
    assert results["status"] == "failed"
    assert results["reason"].startswith("DivergedError: ")
    assert "optimizer.lr" in results["reason"]


def test_one_failed_job_of_a_multirun_fails_the_command_but_not_the_others(command: Command, tmp_path: Path) -> None:
    sweep = f"hydra.sweep.dir={tmp_path}/sweep"
    run = command("train", "-m", sweep, *SMOKE, "trainer.max_steps=2", "optimizer.lr=1e30,0.001,0.002")
    assert run.code == 1
    jobs = [Outcome(0, "", folder) for folder in sorted((tmp_path / "sweep").glob("*_narrow_road_hno_auto_sin*"))]
    assert [job.results["status"] for job in jobs] == ["failed", "finished", "finished"]


def test_without_a_safe_start_the_rate_is_not_applicable(command: Command) -> None:
    run = command("train", *SMOKE, "trainer.max_steps=1", "evaluation.clearance=50")
    assert run.code == 0, run.text
    (row,) = run.results["table"]
    assert (row["safe_starts"], row["marginal"], row["rate"], row["interval"]) == (0, 4, None, None)
    assert "n/a" in run.text
    assert "there is no collision rate" in run.text


def test_numbers_that_json_does_not_know_become_null(tmp_path: Path) -> None:
    results = Results(tmp_path / "results.json", {"game": "any"})
    results.update(metrics={"loss": float("nan"), "worst": float("inf")}, table=[{"rate": float("-inf"), "safe": 3}])
    read = Outcome(0, "", tmp_path).results
    assert read["metrics"] == {"loss": None, "worst": None}
    assert read["table"] == [{"rate": None, "safe": 3}]


def test_results_are_replaced_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    results = Results(tmp_path / "results.json", {"game": "any"})
    before = (tmp_path / "results.json").read_text()

    def full(self: Path, target: Path) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", full)
        with pytest.raises(OSError, match="No space"):
            results.update(status="finished")
    assert (tmp_path / "results.json").read_text() == before
    assert [path.name for path in tmp_path.iterdir()] == ["results.json"]


def test_results_are_there_before_the_run_is_over(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[dict[str, Any]] = []
    original = StopOnDivergence.on_train_batch_end

    def look(self: StopOnDivergence, trainer: Any, *others: Any) -> None:
        seen.append(Outcome(0, "", Path(trainer.default_root_dir)).results)
        original(self, trainer, *others)

    monkeypatch.setattr(StopOnDivergence, "on_train_batch_end", look)
    command("train", *SMOKE, "trainer.max_steps=2")
    assert [results["status"] for results in seen] == ["running"] * 2
    assert seen[0].keys() >= KEYS


def test_every_step_is_logged_once_to_csv_with_finite_losses(command: Command) -> None:
    run = command("train", *SMOKE, "trainer.max_steps=4")
    rows = losses(run.folder)
    assert rows
    assert all(float(row["loss/total"]) > 0 for row in rows)


@pytest.mark.parametrize(("collide", "asked"), [(True, [8]), (False, [8, 40])])
def test_most_validation_labels_are_solved_when_they_are_needed(
    command: Command, monkeypatch: pytest.MonkeyPatch, collide: bool, asked: list[int]
) -> None:
    """The first starts come before the training; the others once none of these collides."""
    starts: list[int] = []

    def solve(game: Game, requests: Sequence[Request], *others: Any, **options: Any) -> tuple[list[Extremal], float]:
        starts.extend(request.starts for request in requests)
        return [fake_labels(game, request.theta, request.starts) for request in requests], 0.0

    def found(played: Trajectory, begun: Starts) -> Score:
        return Score(float(collide), 0.0)

    monkeypatch.setattr(train, "safe_labels_for", solve)
    monkeypatch.setattr(validation, "score", found)
    run = command("train", *SMOKE, "validation.types=1,1", "validation.starts=40", "trainer.max_steps=2")
    assert run.code == 0, run.text
    assert starts == asked
    assert "labels of 8 safe validation starts at each of 1 types" in run.text
