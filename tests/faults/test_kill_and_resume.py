"""A run that was killed goes on in its folder and ends as if it had not been."""

from __future__ import annotations

import json
import random
import shutil
import signal
from pathlib import Path

import pytest

from hno.cli.confs import choices
from hno.cli.curve import CurveLogger, read_rows
from hno.training.saving import LAST, PREVIOUS, read_content
from tests.cli.conftest import Command, clean_globals, command, no_labels, no_pages, refused  # noqa: F401  # fixtures
from tests.cli.wandb_file import history_of
from tests.faults.killed import EVERY, STEPS, TINY, Moment, assert_same, check_equal, curve, results, train

KILLED = -9
MOMENTS = 20
RECIPES = {
    "adam": ("trainer.polish=3",),
    "adamw": ("logger.names=[csv,tensorboard]",),
    "muon": ("sampler=rollout", "data.pretrain=0", "loss.balance=true"),
    "soap": ("data.adaptive={rounds: 2, labels: 3, candidates: 24}",),
}
"""What each optimiser is tried with."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nobody interrupted."""
    folder = tmp_path_factory.mktemp("runs") / "whole"
    assert train(*TINY, f"hydra.run.dir={folder}") == 0
    return folder


@pytest.fixture
def copy(whole: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(whole, tmp_path / "copy"))


def killed(folder: Path, moment: Moment, *words: str) -> Path:
    """A run that was killed at that moment."""
    assert train(*TINY, *words, f"hydra.run.dir={folder}", moment=moment) == KILLED
    return folder


@pytest.mark.parametrize(
    "moment",
    [
        pytest.param(Moment(2), id="before its first checkpoint", marks=pytest.mark.slow),
        pytest.param(Moment(2 * EVERY - 5), id="after a row that no checkpoint has"),
        pytest.param(Moment(2 * EVERY, "on_validation_start"), id="in a validation", marks=pytest.mark.slow),
        pytest.param(Moment(STEPS, "on_validation_end"), id="before its last checkpoint", marks=pytest.mark.slow),
    ],
)
def test_a_killed_run_ends_like_an_uninterrupted_one(whole: Path, tmp_path: Path, moment: Moment) -> None:
    folder = killed(tmp_path / "a run (killed)", moment)
    before = (folder / ".hydra" / "config.yaml").read_bytes()
    begun = results(folder)
    assert begun["status"] == "running"
    assert train(f"resume={folder}") == 0
    check_equal(folder, whole)
    (told,) = results(folder)["resumed"]
    precedes = "validation" in moment.hook  # a checkpoint the step that is validated
    step = moment.step - 1 if precedes else moment.step // EVERY * EVERY
    assert (told["step"], told["changes"]) == (step, {})
    assert told["checkpoint"] == (str(folder / LAST) if step else None)
    assert (folder / ".hydra" / "config.yaml").read_bytes() == before


@pytest.mark.slow
@pytest.mark.parametrize("hook", ["on_train_batch_start", "on_validation_start"])
def test_a_run_that_a_signal_ended_ends_like_an_uninterrupted_one(whole: Path, tmp_path: Path, hook: str) -> None:
    step = 2 * EVERY if "validation" in hook else 49  # the next one has a row
    folder, moment = tmp_path / "run", Moment(step, hook, signal=signal.SIGUSR1)
    assert train(*TINY, f"hydra.run.dir={folder}", moment=moment) == 128 + signal.SIGUSR1
    assert (results(folder)["status"], results(folder)["reason"]) == ("interrupted", "SIGUSR1")
    assert train(f"resume={folder}") == 0
    check_equal(folder, whole)
    assert results(folder)["resumed"][0]["step"] == step + ("batch" in hook)


def test_a_finished_run_with_nothing_new_is_shown(command: Command, copy: Path) -> None:  # noqa: F811
    before = {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()}
    shown = command("train", f"resume={copy}/last.ckpt", folder="none")
    assert shown.code == 0, shown.text
    assert f"The run in {copy} is finished, and nothing is new." in shown.text
    assert "narrow_road / hno / potential / sin" in shown.text
    assert {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()} == before


def test_more_steps_are_supervised_at_the_final_rate(copy: Path, whole: Path) -> None:
    more = STEPS + 50
    assert train(f"resume={copy}", f"trainer.max_steps={more}") == 0
    contents, found = [read_content(copy / name) for name in (PREVIOUS, LAST)], results(copy)
    assert [content["global_step"] for content in contents] == [more - 1, more]
    for content in contents:  # a schedule that was stretched ends at that rate too, but is above it before
        (rate,) = {group["lr"] for state in content["optimizer_states"] for group in state["param_groups"]}
        assert rate == pytest.approx(3e-5, rel=1e-6)
    assert found["steps"] == more
    assert found["config"]["trainer"]["schedule_steps"] == STEPS
    changes = {"trainer.max_steps": [STEPS, more], "trainer.schedule_steps": [None, STEPS]}
    assert [(told["step"], told["changes"]) for told in found["resumed"]] == [(STEPS, changes)]
    rows, first = curve(copy), [row for row in curve(whole) if int(row["step"]) < STEPS]
    assert rows[: len(first)] == first
    assert sorted({int(row["step"]) for row in rows if row["loss/total"]}) == [49, 99, 109, 149, 159]
    (last,) = [row for row in rows if row["loss/total"] and int(row["step"]) == 149]
    assert last["loss/residual"] == "nan"
    assert [int(row["step"]) for row in rows if row["val/value_error"]] == [29, 59, 89, 109, 119, 149, 159]
    assert found["seconds"]["training"] > results(whole)["seconds"]["training"]


def test_another_evaluation_leaves_the_training_as_it_is(copy: Path, whole: Path) -> None:
    assert train(f"resume={copy}", "evaluation.starts=2", "evaluation.dt=0.05", "trainer.accelerator=cpu") == 0
    found, before = results(copy), results(whole)
    assert_same(read_content(copy / LAST), read_content(whole / LAST), LAST)
    assert found["table"][0]["starts"] == 2
    assert found["dt"] == 0.05
    assert found["metrics"] == before["metrics"]
    assert "loss/total" in found["metrics"]
    assert found["resumed"][0]["changes"] == {
        "evaluation.dt": [0.25, 0.05], "evaluation.starts": [4, 2], "trainer.accelerator": ["auto", "cpu"],
    }  # fmt: skip
    rows, first = curve(copy), [row for row in curve(whole) if int(row["step"]) < STEPS]
    assert rows[: len(first)] == first
    assert len(rows) == len(first) + 1


@pytest.mark.usefixtures("no_labels")
def test_another_training_is_refused_with_keys_and_values(command: Command, copy: Path) -> None:  # noqa: F811
    before = (copy / "results.json").read_bytes()
    for words, said in (
        (["seed=3"], "seed: 0, now 3"),
        (["game=drone"], "game.name: 'narrow_road', now 'drone'"),
        (["game.constants.radius=1.0"], "game.constants.radius: None, now 1.0"),
        (["data.trajectories=5"], "data.trajectories: 4, now 5"),
        (["network.width=8"], "network.width: "),
        (["optimizer=adam"], "optimizer.name: 'soap', now 'adam'"),
        (["validation.dt=0.2"], "validation.dt: 0.25, now 0.2"),
        (["trainer.schedule_steps=300"], f"trainer.schedule_steps: {STEPS}, now 300"),
        (["trainer.max_steps=40"], f"is at step {STEPS}, the run ends at step 40"),
        (["experiment=smoke"], "trainer.validate_every: "),
    ):
        run = command("train", f"resume={copy}", *words, folder="none")
        refused(run, said)
        assert run.code == 2
    assert (copy / "results.json").read_bytes() == before


@pytest.mark.usefixtures("no_labels")
def test_what_is_no_run_is_refused(command: Command, copy: Path, tmp_path: Path) -> None:  # noqa: F811
    (copy / "results.json").write_text("[]")
    refused(command("train", f"resume={copy}", folder="none"), f"{copy}/results.json cannot be read")
    (copy / "results.json").unlink()
    refused(command("train", f"resume={copy}", folder="none"), f"{copy}/results.json cannot be read (No such file")
    refused(command("train", f"resume={tmp_path}/none", folder="none"), f"There is no checkpoint at {tmp_path}/none")


def test_a_run_whose_checkpoints_are_all_damaged_is_refused(command: Command, copy: Path) -> None:  # noqa: F811
    for name in (LAST, PREVIOUS):
        (copy / name).write_bytes(b"half")
    run = command("train", f"resume={copy}", "trainer.max_steps=200", folder="none")
    refused(run, f"Every checkpoint in {copy} is damaged: last.ckpt, previous.ckpt")
    assert run.code == 2


def test_a_curve_keeps_whole_rows_before_its_first_step(tmp_path: Path) -> None:
    path = tmp_path / "csv" / "metrics.csv"
    written = CurveLogger(path)
    for step in range(4):
        written.log_metrics({"loss": step / 3} | ({"val": 1.0} if step == 2 else {}), step)
    whole = read_rows(path)
    assert [row["step"] for row in whole] == ["0", "1", "2", "3"]
    with path.open("a") as file:
        file.write("0.1,1")
    assert read_rows(path) == whole
    again = CurveLogger(path, 2)
    assert [row["loss"] for row in read_rows(path)] == [str(step / 3) for step in range(2)]
    for step in (2, 3):
        again.log_metrics({"loss": step / 3} | ({"val": 1.0} if step == 2 else {}), step)
    assert read_rows(path) == whole
    CurveLogger(path)
    assert not path.exists()


@pytest.mark.slow
@pytest.mark.parametrize("number", range(MOMENTS))
def test_killed_at_a_random_moment(whole: Path, tmp_path: Path, number: int) -> None:
    """Of a step, a save, a validation, the switches between phases, the end of the training or the evaluation."""
    draw = random.Random(number)
    step = draw.randrange(STEPS) if number % 2 else draw.choice([0, 33, 77, *range(EVERY, STEPS, EVERY), STEPS]) - 1
    hook = draw.choice(["on_train_batch_start", "on_train_batch_end"]) if step >= 0 else "on_train_start"
    folder = tmp_path / "killed"
    train(*TINY, f"hydra.run.dir={folder}", moment=Moment(max(step, 0), hook, draw.uniform(0.001, 0.5)))
    print(f"{hook} of step {step}: {results(folder)['status']}")
    assert train(f"resume={folder}") == 0
    check_equal(folder, whole)


@pytest.mark.slow
@pytest.mark.parametrize("optimizer", sorted(choices("optimizer")))
def test_every_optimizer_goes_on_bit_by_bit(tmp_path: Path, optimizer: str) -> None:
    words = (f"optimizer={optimizer}", *RECIPES.get(optimizer, ()))
    assert train(*TINY, *words, f"hydra.run.dir={tmp_path}/whole") == 0
    for moment in (Moment(75), Moment(STEPS, "on_validation_start")):
        folder = killed(tmp_path / f"killed at {moment.step}", moment, *words)
        assert train(f"resume={folder}") == 0
        check_equal(folder, tmp_path / "whole")


@pytest.mark.slow
def test_a_run_that_is_killed_again_and_again_ends_the_same(whole: Path, tmp_path: Path) -> None:
    folder = killed(tmp_path / "killed", Moment(40))
    for step in (60, 61, 80, 91, STEPS):
        moment = Moment(step, "on_train_batch_end")
        assert train(f"resume={folder}", moment=moment) == KILLED
    assert train(f"resume={folder}") == 0
    check_equal(folder, whole)
    assert [told["step"] for told in results(folder)["resumed"]] == [30, 30, 60, 60, 90, 90]


@pytest.mark.slow
def test_an_offline_wandb_run_goes_on_under_its_id(whole: Path, tmp_path: Path) -> None:
    folder = killed(tmp_path / "killed", Moment(75), "logger=wandb", "logger.mode=offline")
    assert train(f"resume={folder}") == 0
    files = sorted(folder.glob("wandb/offline-run-*/run-*.wandb"))
    assert len(files) == 2
    assert len({file.stem for file in files}) == 1
    rows = [row for file in files for row in history_of(file) if "loss/total" in row]
    steps = [row["trainer/global_step"] for row in rows]  # a kill loses what W&B has not written yet; the csv has it
    assert steps == sorted(set(steps))
    assert 99 in steps
    kept = {int(row["step"]): float(row["loss/total"]) for row in curve(whole) if row["loss/total"]}
    assert [row["loss/total"] for row in rows] == pytest.approx([kept[step] for step in steps], rel=1e-12)
    assert json.loads((folder / "results.json").read_text())["status"] == "finished"
