"""What users of Lightning and Hydra look for: groups, callbacks, arguments of the trainer, and what a job returns."""

from __future__ import annotations

import csv
import inspect
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lightning as L
import pytest

from hno.cli import launch
from hno.cli.arguments import Arguments
from hno.cli.config import read
from hno.cli.help import configuration_help
from hno.cli.objective import objective
from hno.cli.results import Results
from hno.cli.resume import training_hash
from hno.cli.settings import COMMANDS, TrainSettings
from hno.training.callbacks import callbacks
from hno.training.settings import Settings
from hno.training.trainer import CONTROLLED, OWN, PROFILERS, make_trainer
from tests.cli.conftest import SMOKE, Command, refused
from tests.cli.test_configs import composed


def settings(*overrides: str) -> TrainSettings:
    """The settings of a training, as the schema takes them."""
    return read(TrainSettings, composed(*overrides))


def test_every_argument_of_the_trainer_is_ours_or_refused_with_a_reason_or_can_be_given(tmp_path: Path) -> None:
    known = set(inspect.signature(L.Trainer).parameters)
    assert set(CONTROLLED) < known
    assert set(OWN) < known
    free = {name: parameter.default for name, parameter in inspect.signature(L.Trainer).parameters.items()}
    free = {name: default for name, default in free.items() if name not in {*CONTROLLED, *OWN}}
    make_trainer(Settings(accelerator="cpu", lightning=free), tmp_path, [], [])


def test_arguments_of_the_trainer_reach_it() -> None:
    chosen = settings("trainer.min_steps=7", "+trainer.detect_anomaly=true", "trainer.gradient_clip_algorithm=value")
    expected = {"min_steps": 7, "detect_anomaly": True, "gradient_clip_algorithm": "value"}
    assert chosen.trainer.lightning == expected
    trainer = make_trainer(Settings(accelerator="cpu", lightning=expected), Path(), [], [])
    assert (trainer.min_steps, trainer._detect_anomaly, trainer.gradient_clip_algorithm) == (7, True, "value")


@pytest.mark.parametrize(
    ("word", "fragments"),
    [
        ("+trainer.fast_dev_run=true", ["trainer.fast_dev_run", "debug=fast"]),
        ("trainer.max_epochs=3", ["trainer.max_epochs", "trainer.max_steps"]),
        ("trainer.strategy=fsdp", ["trainer.strategy must be auto, single_device, ddp; got 'fsdp'"]),
        ("trainer.min_step=3", ["trainer.min_step does not exist", "Did you mean 'min_steps'"]),
        ("+evaluation.robustness=true", ["evaluation.robustness does not exist"]),
        ("callbacks.early_stoping={}", ["callbacks.early_stoping does not exist", "'early_stopping'"]),
        ("callbacks.early_stopping.patients=3", ["patients does not exist", "'patience'"]),
        ("callbacks._target_=os.system", ["callbacks._target_ does not exist"]),
        ("trainer.profiler=slow", ["trainer.profiler must be 'simple', 'advanced' or 'pytorch'"]),
    ],
)
@pytest.mark.usefixtures("no_labels")
def test_what_nothing_reads_is_refused(command: Command, word: str, fragments: list[str]) -> None:
    run = command("train", *SMOKE, word, "--dry-run")
    refused(run, *fragments)
    assert run.code == 2


def test_callbacks_are_chosen_together_by_name() -> None:
    chosen = settings("callbacks=[early_stopping,learning_rate]", "callbacks.early_stopping.patience=2")
    assert chosen.callbacks["early_stopping"]["patience"] == 2
    assert list(chosen.callbacks) == ["early_stopping", "learning_rate"]
    assert settings("callbacks=early_stopping", "callbacks.early_stopping=null").callbacks == {}


@pytest.mark.parametrize("name", callbacks.names())
def test_files_of_callbacks_say_the_defaults(name: str) -> None:
    given = settings(f"callbacks={name}").callbacks[name]
    assert given == settings(f"callbacks.{name}={{}}").callbacks[name]


@pytest.mark.parametrize("name", PROFILERS)
def test_profilers_are_a_group(name: str) -> None:
    assert settings(f"profiler={name}").trainer.profiler == name


def test_debug_is_laid_over_an_experiment() -> None:
    chosen = settings("experiment=smoke", "debug=default")
    assert (chosen.trainer.max_steps, chosen.trainer.lightning) == (4, {"detect_anomaly": True})
    assert chosen.operator.name == "hno"
    assert settings("debug=profiler").trainer.profiler == "simple"


def test_a_run_that_stops_early_is_finished(command: Command) -> None:
    early = ["callbacks.early_stopping={patience: 1, min_delta: 100}", "callbacks.learning_rate={}"]
    run = command(
        "train",
        *SMOKE,
        *early,
        "trainer.max_steps=30",
        "trainer.validate_every=2",
        "profiler=simple",
        "trainer.log_every_n_steps=1",
    )
    assert run.code == 0, run.text
    assert run.results["steps"] == 4
    rows = list(csv.DictReader((run.folder / "csv" / "metrics.csv").open()))
    assert any(value for row in rows for name, value in row.items() if name.startswith("lr-"))
    assert "run_training_batch" in (run.folder / "fit-profile.txt").read_text()
    again = command("train", f"resume={run.folder}", "evaluation.starts=2")
    assert again.results["steps"] == 4, "nothing is trained on"


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [("val/value_error", 0.5), ("best/excess_cost", 0.1), (["best/collision_rate", "loss/total"], [0.0, 2.0])],
)
def test_a_job_returns_the_chosen_numbers(wanted: Any, expected: Any) -> None:
    content = {"metrics": {"val/value_error": 0.5, "loss/total": 2.0}, "table": [], "seconds": {}}
    content["validation"] = {"collision_rate": 0.0, "excess": 0.1}
    assert objective(SimpleNamespace(objective=wanted), content) == expected
    assert objective(SimpleNamespace(objective=wanted), content | {"status": "pruned"}) is None


def test_a_job_without_the_number_returns_none(caplog: pytest.LogCaptureFixture) -> None:
    wanted = SimpleNamespace(objective="test/collision_rate")
    assert objective(wanted, {"metrics": {"loss/total": 2.0}, "table": [], "seconds": {}}) is None
    assert "no number test/collision_rate; it has loss/total" in caplog.text


def test_the_sweeper_sees_what_jobs_return(command: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen, original = list[Any](), launch.under_hydra

    def performed(task: Any, chosen: TrainSettings, folder: Path) -> Any:
        metrics = {"loss/total": float(chosen.seed)}
        status = "finished" if chosen.seed else "failed"
        results = Results(folder / "results.json", {"metrics": metrics, "table": [], "seconds": {}})
        results.update(status=status, reason=None)
        return results if chosen.seed else None

    def under_hydra(name: str, job: Any, words: Any) -> None:
        original(name, lambda config: seen.append(job(config)), words)

    monkeypatch.setattr(launch, "perform", performed)
    monkeypatch.setattr(launch, "under_hydra", under_hydra)
    words = ["-m", *SMOKE, "objective=loss/total", "seed=0,3", f"hydra.sweep.dir={tmp_path / 'sweep'}"]
    assert command("train", *words, folder="none").code == 1
    assert seen == [None, 3.0]


@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "train"])
def test_help_explains_every_key(name: str) -> None:
    _explained(configuration_help(name, Arguments([], [], {})))


@pytest.mark.parametrize(
    "words", [[], ["operator=hno", "optimizer=muon"], ["optimizer=adamw", "callbacks=early_stopping"]]
)
def test_help_of_a_training_explains_every_key_and_group(words: list[str]) -> None:
    text = configuration_help("train", Arguments([], words, {}))
    groups = re.findall(r"^  (\w+): \S", text.partition("Keys, key=value")[0], re.MULTILINE)
    assert {"callbacks", "debug", "profiler", "trainer", "experiment"} <= set(groups)
    _explained(text)


def _explained(text: str) -> None:
    """Every key that holds a value has a comment, or stands below one that has."""
    keys = text.partition("Keys, key=value\n")[2].splitlines()
    above = list[tuple[int, bool]]()
    for line in keys:
        depth, said = len(line) - len(line.lstrip()), "#" in line
        above = [entry for entry in above if entry[0] < depth]
        assert said or line.rstrip().endswith(":") or any(explained for _, explained in above[1:]), line
        above.append((depth, said))


def test_tags_and_notes_change_nothing_of_the_steps() -> None:
    watched = settings(
        "tags=[a,b]", "notes=why", "profiler=simple", "trainer.detect_anomaly=true", "objective=loss/total"
    )
    assert training_hash(watched) == training_hash(settings())
    assert training_hash(settings("trainer.gradient_clip_algorithm=value")) != training_hash(settings())
    assert "tags" in composed()
