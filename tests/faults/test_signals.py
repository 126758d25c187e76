"""Signals: a checkpoint, an exit code, a word in the results, and no process that stays."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import lightning as L
import pytest
import torch

import hno
from hno import processes
from hno.cli import calls, evaluate
from hno.cli.progress import StepLines
from hno.processes import Interrupted, interruptible, interruptible_call, stop_if_asked, waiting_signals
from hno.training.saving import LAST, read_content
from tests.cli import conftest
from tests.cli.conftest import SMOKE, Command, Outcome
from tests.faults.signalled import Left, started

clean_globals, command, no_pages = conftest.clean_globals, conftest.command, conftest.no_pages
random_checkpoint = conftest.random_checkpoint

SIGNALS = {"SIGTERM": 143, "SIGINT": 130, "SIGHUP": 129, "SIGUSR1": 138}


@pytest.fixture(autouse=True)
def usual_handlers() -> Iterator[None]:
    """Tests may run in the background of a script, where SIGINT is ignored, which processes inherit."""
    before = {name: signal.signal(getattr(signal, name), signal.SIG_DFL) for name in SIGNALS}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for name, handler in before.items():
        signal.signal(getattr(signal, name), handler)


def send(name: str = "SIGTERM") -> None:
    os.kill(os.getpid(), getattr(signal, name))


def answer(*names: str, waits: bool = False, seconds: float = 0.0) -> Interrupted:
    """What signals raise, or the look for one some time after them."""
    with pytest.raises(Interrupted) as stop, interruptible(), waiting_signals() if waits else nullcontext():
        ask(names, seconds)
    return stop.value


def ask(names: tuple[str, ...], seconds: float) -> None:
    for name in names:
        send(name)
    time.sleep(seconds)
    stop_if_asked()


@pytest.mark.parametrize("name", SIGNALS)
def test_a_signal_is_an_exception_with_its_exit_code(name: str) -> None:
    stop = answer(name)
    assert (str(stop), stop.code, stop.between) == (name, SIGNALS[name], False)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler, "handlers are what they were"
    stop_if_asked()  # it was answered


def test_a_signal_waits_for_a_moment_when_nothing_is_half_done() -> None:
    assert answer("SIGTERM", waits=True).between


def test_a_signal_does_not_wait_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "GRACE", 0.05)
    stop = answer("SIGHUP", waits=True, seconds=10.0)
    assert (str(stop), stop.between) == ("SIGHUP", False)


def test_signals_of_one_moment_are_one_and_a_later_one_ends_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    assert answer("SIGTERM", "SIGINT", waits=True).between
    monkeypatch.setattr(processes, "SAME", 0.0)
    stop = answer("SIGTERM", "SIGINT", waits=True)
    assert (str(stop), stop.between) == ("SIGTERM", False)


@pytest.mark.parametrize("name", SIGNALS)
def test_what_ignores_a_signal_goes_on_ignoring_it(name: str) -> None:
    signal.signal(getattr(signal, name), signal.SIG_IGN)
    with interruptible():
        send(name)


@pytest.fixture
def signal_at_step_7(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A signal in the middle of the work that follows a step."""
    original = StepLines.on_train_batch_end

    def sending(self: StepLines, trainer: L.Trainer, *others: Any) -> None:
        original(self, trainer, *others)
        if trainer.global_step == 7:
            send()

    with monkeypatch.context() as patch:
        patch.setattr(StepLines, "on_train_batch_end", sending)
        yield


def test_a_signal_ends_a_training_between_two_steps_and_it_goes_on_from_there(
    command: Command,
    tmp_path: Path,
    request: pytest.FixtureRequest,
) -> None:
    whole = command("train", *SMOKE, folder=tmp_path / "whole")
    request.getfixturevalue("signal_at_step_7")
    run = command("train", *SMOKE)
    assert (run.code, run.results["status"], run.results["reason"]) == (143, "interrupted", "SIGTERM")
    assert read_content(run.folder / LAST)["global_step"] == 7
    said = f"Interrupted by SIGTERM. In training, 7 of 10 done. Go on with: hno train resume={run.folder}."
    assert run.text.splitlines()[-1] == said
    assert "Traceback" not in run.text
    again = command("train", *SMOKE, f"resume={run.folder / LAST}")
    assert again.results["status"] == "finished"
    one, other = (read_content(outcome.folder / LAST) for outcome in (whole, again))
    for name, weights in one["state_dict"].items():
        assert torch.equal(weights, other["state_dict"][name])
    assert again.results["table"] == whole.results["table"]


@pytest.mark.usefixtures("signal_at_step_7", "clean_globals")
def test_a_signal_ends_a_training_that_a_program_calls(tmp_path: Path, cache: Path) -> None:
    settings = {"experiment": "smoke", "data.types": [[1, 1]], "data.workers": 1, "evaluation.dt": 0.1}
    with pytest.raises(SystemExit) as stop:
        hno.train("narrow_road", "hno", tmp_path, settings)
    assert stop.value.code == 143
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert read_content(tmp_path / LAST)["global_step"] == 7
    assert json.loads((tmp_path / "results.json").read_text())["reason"] == "SIGTERM"


@pytest.mark.parametrize("call", [hno.train, hno.evaluate, hno.certify])
def test_every_call_ends_in_its_exit_code(monkeypatch: pytest.MonkeyPatch, call: Callable[[str], object]) -> None:
    monkeypatch.setattr(calls, "_overrides", lambda *given: send())
    with pytest.raises(SystemExit) as stop:
        call("narrow_road")
    assert stop.value.code == 143


@pytest.mark.parametrize(("name", "end"), [("SIGINT", KeyboardInterrupt), ("SIGHUP", SystemExit)])
def test_a_signal_ends_a_call_as_programs_know_it(name: str, end: type[BaseException]) -> None:
    with pytest.raises(end), interruptible_call():
        send(name)
    with pytest.raises(Interrupted), interruptible(), interruptible_call():
        send(name)


def test_a_signal_ends_an_evaluation(
    command: Command,
    random_checkpoint: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(evaluate, "play", lambda *arguments: send("SIGUSR1"))
    run = command("evaluate", f"checkpoint={random_checkpoint}", "starts=4", "theta=1,1", "workers=1")
    assert (run.code, run.results["status"], run.results["reason"]) == (138, "interrupted", "SIGUSR1")
    assert run.text.splitlines()[-1] == "Interrupted by SIGUSR1. In evaluation, 0 of 1 done."


def test_a_signal_ends_a_sweep_with_its_table(
    command: Command,
    tmp_path: Path,
    signal_at_step_7: None,
) -> None:
    run = command("train", "-m", *SMOKE, "seed=0,1", f"hydra.sweep.dir={tmp_path}/sweep")
    assert run.code == 143
    assert "1 job " in run.text
    assert "Job 0 interrupted: SIGTERM" in run.text


def labels(cache: Path) -> tuple[str, ...]:
    return ("labels", "game=narrow_road", "theta=1,1", "n=2000", "workers=2", f"cache={cache}")


@pytest.mark.parametrize(("name", "code"), [pytest.param("SIGINT", 130, marks=pytest.mark.slow), ("SIGKILL", -9)])
def test_no_label_worker_outlives_its_parent(tmp_path: Path, name: str, code: int) -> None:
    cache = tmp_path / "cache"
    with started("labels", tmp_path, cache, *labels(cache)) as command:
        command.until(lambda: any(cache.rglob(".claim-*")))
        left = command.end(getattr(signal, name))
    assert (left.code, left.processes) == (code, [])
    assert "Traceback" not in left.text
    assert name == "SIGKILL" or "Finished shards are kept" in left.text.splitlines()[-1]


TRAIN = ("train", *SMOKE, "data.workers=2", "trainer.max_steps=40", "trainer.validate_every=10")
WORK = {
    "labels in training": ("labels", (*TRAIN, "data.trajectories=2000")),
    "training": ("training", TRAIN),
    "validation": ("validation", TRAIN),
    "rounds": ("rounds", (*TRAIN, "data.adaptive={rounds: 1, labels: 600, candidates: 700}")),
    "evaluation": ("evaluation", TRAIN),
    "sections": ("sections", TRAIN),
    "evaluate": ("evaluation", ("evaluate", "starts=4", "theta=1,1", "workers=2")),
}
LAUNCHERS = {
    "basic": (),
    "joblib": ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2"),
    "submitit": ("hydra/launcher=submitit_local", "hydra.launcher.timeout_min=5"),
}


def after(name: str, work: str, tmp_path: Path, cache: Path, *further: str) -> tuple[Left, list[Outcome]]:
    """What is left of a command after a signal in its work, and of its runs."""
    phase, words = WORK[work]
    folder, own = tmp_path / "run", tmp_path / "labels" if phase == "labels" else cache
    with started(phase, tmp_path, own, *words, *further, "--to", str(folder)) as command:
        command.until(lambda: (tmp_path / "mark").exists() or (phase == "labels" and any(own.rglob(".claim-*"))))
        left = command.end(getattr(signal, name))
    runs = [path.parent for path in sorted(folder.rglob("results.json"))]
    return left, [Outcome(left.code, left.text, run) for run in runs]


@pytest.mark.slow
@pytest.mark.parametrize("work", WORK)
def test_every_signal_in_every_work(tmp_path: Path, cache: Path, random_checkpoint: Path, work: str) -> None:
    for name, code in SIGNALS.items():
        further = [f"checkpoint={random_checkpoint}"] if work == "evaluate" else []
        left, (run,) = after(name, work, tmp_path / name, cache, *further)
        assert (left.code, left.processes) == (code, []), left.text
        assert left.seconds < 5.0 + 3.0
        assert "Traceback" not in left.text
        assert f"Interrupted by {name}." in left.text
        assert (run.results["status"], run.results["reason"]) == ("interrupted", name)
        assert (run.folder / LAST).exists() == (work in ("training", "validation", "rounds", "evaluation", "sections"))
        print(f"{work}, {name}: ended after {left.seconds:.1f} s with {left.code}")


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT"])
def test_a_signal_ends_every_sweep(tmp_path: Path, cache: Path, launcher: str, name: str) -> None:
    left, found = after_in_a_sweep(name, launcher, tmp_path, cache)
    many = 1 if launcher == "basic" else 2
    assert (left.code, left.processes) == (SIGNALS[name], []), left.text
    assert found == [("interrupted", name)] * many
    assert left.text.count(f"interrupted: {name}") == many
    assert "Traceback" not in left.text
    print(f"{launcher}, {name}: {many} jobs ended after {left.seconds:.1f} s with {left.code}")


@pytest.mark.slow
def test_no_job_outlives_a_sweep_that_is_killed(tmp_path: Path, cache: Path) -> None:
    left, found = after_in_a_sweep("SIGKILL", "joblib", tmp_path, cache)
    assert (left.code, left.processes) == (-9, []), left.text
    assert found == [("interrupted", "SIGTERM")] * 2
    assert len([*(tmp_path / "run").rglob(LAST)]) == 2


@pytest.mark.slow
def test_a_signal_to_one_job_ends_that_one_alone(tmp_path: Path, cache: Path) -> None:
    """As a scheduler sends it."""
    runs = tmp_path / "run"
    steps = ("trainer.max_steps=200", "data.workers=1", "seed=0,1", *LAUNCHERS["joblib"], "--to", str(runs))
    with started("sweep", tmp_path, cache, *TRAIN, *steps, "-m") as command:
        command.until(lambda: any("step 5 of" in log.read_text() for log in runs.glob("0_*/train.log")))
        (entry,) = runs.glob(".jobs-*/0.json")
        os.kill(json.loads(entry.read_text())["process"][1], signal.SIGTERM)
        command.process.wait(300)
    found = {path.parent.name[0]: json.loads(path.read_text())["status"] for path in runs.rglob("results.json")}
    assert found == {"0": "interrupted", "1": "finished"}


def after_in_a_sweep(name: str, launcher: str, tmp_path: Path, cache: Path) -> tuple[Left, list[tuple[str, str]]]:
    """What is left of a sweep after a signal while its jobs train, and what became of them."""
    if launcher != "basic":
        pytest.importorskip(f"hydra_plugins.hydra_{launcher}_launcher")
    steps = ("trainer.max_steps=100000", "trainer.compile=false", "trainer.validate_every=100000")
    runs, many = tmp_path / "run", 1 if launcher == "basic" else 2
    words = (*TRAIN, *steps, "data.workers=1", "seed=0,1", *LAUNCHERS[launcher], "--to", str(runs))
    with started("sweep", tmp_path, cache, *words, "-m") as command:
        command.until(lambda: sum("step 5 of" in log.read_text() for log in runs.rglob("train.log")) == many)
        left = command.end(getattr(signal, name), 20.0 if name == "SIGKILL" else 3.0)
    found = [json.loads(path.read_text()) for path in runs.rglob("results.json")]
    return left, [(results["status"], results["reason"]) for results in found]
