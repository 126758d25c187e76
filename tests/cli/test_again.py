"""A sweep that is run again in its folder."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from hno.cli import again, evaluate, launch
from hno.cli.again import NEW, REPEATED, RESUMED_JOB, SKIPPED, check_same, going_on, planned
from hno.cli.arguments import UsageError, parse
from hno.cli.calls import train_settings
from hno.cli.config import read
from hno.cli.objective import Objective, objective
from hno.cli.perform import Task
from hno.cli.results import Results
from hno.cli.resume import own_configuration
from hno.cli.schema import SettingsError
from hno.cli.settings import TrainSettings
from hno.cli.sweep import Ledger
from hno.training.saving import BEST, LAST
from tests.cli.conftest import SMOKE, Command


@pytest.fixture(scope="module")
def settings() -> TrainSettings:
    return train_settings(list(SMOKE))


def leave(folder: Path, settings: TrainSettings, status: str, **changed: Any) -> Path:
    """The folder of a job that ended, or did not; some entries of its configuration were others."""
    config = settings.model_dump(exclude={"resume"}, mode="json")
    for key, value in changed.items():
        part, _, name = key.partition("__")
        config[part][name] = value
    folder.mkdir(exist_ok=True)
    content = {"status": status, "reason": None, "seconds": {}, "config": config}
    (folder / "results.json").write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize(
    ("status", "plan"), [("finished", SKIPPED), ("failed", REPEATED), ("interrupted", REPEATED), ("running", REPEATED)]
)
def test_what_is_done_with_a_job_follows_from_how_it_ended(
    tmp_path: Path, settings: TrainSettings, status: str, plan: str
) -> None:
    assert planned(leave(tmp_path / "job", settings, status), settings) == plan


def test_a_stopped_job_goes_on_from_a_sound_checkpoint_alone(
    tmp_path: Path, settings: TrainSettings, random_checkpoint: Path
) -> None:
    for status in ("interrupted", "running"):
        folder = leave(tmp_path / status, settings, status)
        (folder / LAST).write_bytes(random_checkpoint.read_bytes())
        assert planned(folder, settings) == RESUMED_JOB
        (folder / LAST).write_bytes(random_checkpoint.read_bytes()[:-9])
        assert planned(folder, settings) == REPEATED


@pytest.mark.parametrize("content", ["", "[]", '{"status": "finished"}', '{"status": 3, "config": {}}'])
def test_results_that_say_nothing_are_none(tmp_path: Path, settings: TrainSettings, content: str) -> None:
    assert planned(tmp_path, settings) == NEW
    (tmp_path / "results.json").write_text(content)
    assert planned(tmp_path, settings) == REPEATED


@pytest.mark.parametrize("status", ["finished", "interrupted"])
def test_results_of_other_settings_are_refused_with_what_differs(
    tmp_path: Path, settings: TrainSettings, status: str
) -> None:
    folder = leave(tmp_path / "job", settings, status, data__workers=7, evaluation__starts=99)
    with pytest.raises(SettingsError, match=r"(?s)other settings.*evaluation\.starts: 99, now 4") as refused:
        planned(folder, settings)
    assert "workers" not in str(refused.value), "it changes no number"


def test_an_evaluation_is_repeated_if_its_model_is_newer(tmp_path: Path, settings: TrainSettings) -> None:
    folder, model = leave(tmp_path / "job", settings, "finished"), tmp_path / "model"
    model.touch()
    os.utime(model, (1, 1))
    assert planned(folder, settings, [model]) == SKIPPED
    os.utime(model, (4e9, 4e9))
    assert planned(folder, settings, [model]) == REPEATED


def record(folder: Path, *words: str, hydra: tuple[str, ...] = (), command: str = "train") -> Path:
    """What Hydra leaves of a sweep."""
    folder.mkdir(exist_ok=True)
    content = {"hydra": {"job": {"name": command}, "overrides": {"task": list(words), "hydra": list(hydra)}}}
    (folder / "multirun.yaml").write_text(yaml.dump(content))
    return folder


def test_the_folder_of_another_sweep_is_refused_with_what_differs(tmp_path: Path) -> None:
    folder = record(tmp_path, "game=drone", "++seed=0,1", "++data.workers=2", hydra=("hydra.sweep.dir=x",))
    elsewhere = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "hydra.sweep.dir=y", "++data.workers=1")
    check_same(folder, "train", ["++seed=0,1", "game=drone", *elsewhere])
    with pytest.raises(UsageError) as refused:
        check_same(folder, "train", ["++seed=0,1,2", "operator=sno"])
    assert refused.value.args[0].splitlines()[1:4] == [
        "  game: drone, now not given", "  operator: not given, now sno", "  seed: 0,1, now 0,1,2",
    ]  # fmt: skip
    with pytest.raises(UsageError, match="a sweep of hno train, not of hno evaluate"):
        check_same(folder, "evaluate", [])


def test_the_folder_is_enough_but_not_for_words_that_could_run_code(tmp_path: Path) -> None:
    words, place = ("game=drone", "++seed=0,1"), f"hydra.sweep.dir='{tmp_path}'"
    record(tmp_path, *words, hydra=("hydra.mode=MULTIRUN", "hydra/launcher=joblib", "hydra.sweep.subdir=z"))
    given, folder = going_on(parse(["data.workers=1", f"sweep={tmp_path}"]))
    assert (folder, "--multirun" in given.flags) == (tmp_path, True)
    assert given.overrides == [*words, "data.workers=1", place]
    again_given, _ = going_on(parse(["-m", "game=lane_change", f"sweep={tmp_path}"]))
    assert again_given.overrides == ["game=lane_change", place]
    hostile = "+hydra.callbacks.x._target_=os.system"
    for content in ({"hydra": (hostile,)}, {"words": (hostile,)}, {"hydra": ("hydra/sweeper=optuna",)}):
        record(tmp_path, *content.get("words", ()), hydra=content.get("hydra", ()))
        with pytest.raises(UsageError, match="give its whole command line again"):
            going_on(parse([f"sweep={tmp_path}"]))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("sweep=",), "needs the folder of a sweep"),
        (("sweep=null",), "needs the folder of a sweep"),
        (("sweep=nowhere",), "There is no sweep to go on with"),
        (("sweep=there", "--to", "x"), "leave --to"),
        (("sweep=there", "resume=x"), "leave resume= out"),
    ],
)
def test_words_that_contradict_it(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "there", "seed=0,1")
    run = command("train", "-m", *words, folder="none")
    assert (run.code, message in run.text) == (2, True), run.text
    assert [path.name for path in tmp_path.iterdir()] == ["there"]


Done = list[tuple[int, str | None]]


@pytest.fixture
def performed(monkeypatch: pytest.MonkeyPatch) -> Callable[[dict[int, str]], Done]:
    """Jobs that end as they are told to, by seed; returns who was performed, and what it went on from."""
    ends, done = dict[int, str](), Done()

    def fake(task: Task, settings: TrainSettings, folder: Path) -> Results | None:
        done.append((settings.seed, settings.resume))
        status = ends[settings.seed]
        head = {**task.head(settings), "metrics": {"best/collision_rate": settings.seed / 10}}
        results = Results(folder / "results.json", head)
        (folder / BEST).touch()
        results.update(status=status, reason=None if status == "finished" else "told to")
        return results if status == "finished" else None

    monkeypatch.setattr(launch, "perform", fake)
    monkeypatch.setattr("hno.cli.train.check", lambda config: read(TrainSettings, own_configuration(config)))
    monkeypatch.setattr(again, "newest", lambda folder: folder / LAST)

    def told(by_seed: dict[int, str]) -> Done:
        ends.clear()
        done.clear()
        ends.update(by_seed)
        return done

    return told


def test_a_sweep_goes_on_where_it_was(
    command: Command, tmp_path: Path, performed: Callable[[dict[int, str]], Done], monkeypatch: pytest.MonkeyPatch
) -> None:
    returned: list[Objective] = []
    monkeypatch.setattr(launch, "objective", lambda *job: returned.append(objective(*job)) or returned[-1])
    sweep, words = tmp_path / "sweep", ("-m", *SMOKE, "seed=1,2,3")
    done = performed({1: "finished", 2: "failed", 3: "interrupted"})
    first = command("train", *words, "--to", str(sweep), folder="none")
    assert (first.code, returned) == (1, [0.1])
    assert f"Run again what is not finished: hno train sweep={sweep}" in first.text
    assert "Job 1 failed: told to" in (sweep / "sweep.log").read_text()
    done = performed({2: "finished", 3: "finished"})
    second = command("train", *words, f"sweep={sweep}", folder="none")
    assert second.code == 0, second.text
    assert done == [(2, None), (3, str(next(sweep.glob("2_*"))))]
    assert returned == [0.1, 0.1, 0.2, 0.3], "of the one that is skipped too"
    for job, how in enumerate(("skipped", "repeated", "resumed")):
        assert f"Job {job} finished, {how}\n" in (sweep / "sweep.log").read_text()
    refused = command("train", "-m", *SMOKE, "seed=1,2,3", "optimizer.lr=1", f"sweep={sweep}", folder="none")
    assert (refused.code, "optimizer.lr: not given, now 1" in refused.text) == (2, True)


def test_a_job_that_a_cluster_begins_again_goes_on(
    command: Command,
    tmp_path: Path,
    settings: TrainSettings,
    performed: Callable[[dict[int, str]], Done],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its node failed: to the sweep it has begun already, and its folder says that it runs."""
    (tmp_path / "sweep").mkdir()
    job, done = tmp_path / "sweep" / "0_narrow_road_hno_auto_sin", performed({0: "finished"})
    leave(job, settings, "running")
    monkeypatch.setattr(Ledger, "knows", lambda ledger, job: True)
    run = command("train", "-m", *SMOKE, "--to", str(tmp_path / "sweep"), folder="none")
    assert (run.code, done) == (0, [(0, str(job))]), run.text
    assert "finished, resumed" in run.text


def test_a_job_that_is_refused_keeps_the_results_of_its_folder(
    command: Command, tmp_path: Path, settings: TrainSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep = record(tmp_path / "sweep", *SMOKE)
    job = leave(sweep / "0_narrow_road_hno_auto_sin", settings, "finished")
    left = (job / "results.json").read_bytes()

    def broken(*arguments: object) -> None:
        raise ValueError("the game is no longer installed")

    monkeypatch.setattr("hno.cli.train.check", broken)
    run = command("train", f"sweep={sweep}", folder="none")
    assert run.code == 1
    assert "Job 0 refused: the game is no longer installed" in run.text
    assert (job / "results.json").read_bytes() == left


def test_models_of_an_evaluation_are_what_it_reads(random_checkpoint: Path) -> None:
    given = [str(random_checkpoint), str(random_checkpoint.parent)]
    chosen = type("Settings", (), {"checkpoint": given})
    assert evaluate.models_of(chosen) == [random_checkpoint] * 2  # type: ignore[arg-type]
