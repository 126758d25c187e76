from __future__ import annotations

import itertools
import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest
import wandb

from hno.cli import logs
from hno.cli.logs import wandb_mode
from hno.cli.media import numbers
from tests.cli.conftest import SMOKE, Command, Outcome
from tests.cli.wandb_file import offline_run

ROOT = Path(__file__).parents[2]


def multirun(folder: Path, *overrides: str) -> str:
    """Run the multirun command of the documentation, tiny, as a process of its own."""
    arguments = [sys.executable, str(ROOT / "train.py"), "-m", *overrides, "experiment=smoke", "logger=wandb"]
    small = ["data.types=[[1,1]]", "data.workers=1", "trainer.max_steps=5", "evaluation.dt=0.25"]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "HOME": str(folder)}
    done = subprocess.run(
        [*arguments, *small, f"hydra.sweep.dir={folder}/sweep"],
        cwd=folder, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    printed = done.stdout + done.stderr
    assert done.returncode == 0, printed
    return printed


def check_jobs(folder: Path, games: str, operators: str, activations: str) -> None:
    """One folder, one results.json and one offline W&B run for each combination."""
    wanted = list(itertools.product(*(names.split(",") for names in (games, operators, activations))))
    folders = sorted((folder / "sweep").glob("[0-9]*"), key=lambda path: int(path.name.split("_")[0]))
    got = [Outcome(0, "", job).results for job in folders]
    assert [(r["game"], r["operator"], r["activation"]) for r in got] == wanted
    assert [(r["status"], r["steps"]) for r in got] == [("finished", 5)] * len(wanted)
    runs = [offline_run(job) for job in folders]
    assert len({run.id for run in runs}) == len(wanted)
    assert [(run.name, run.group, run.exit_code) for run in runs] == [(job.name, "sweep", 0) for job in folders]
    assert [(run.config["game"]["name"], run.config["operator"]["name"], run.config["activation"]["name"])
            for run in runs] == wanted  # fmt: skip
    for run, results in zip(runs, got, strict=True):
        expected = {**numbers(results), "status": "finished", "reason": None}
        assert expected.keys() >= {"test/excess_cost", "collision_rate/1,1", "seconds/training"}
        assert {name: run.summary[name] for name in expected} == expected
        assert run.summary.keys() >= {"rollout/filenames", "collision_map/filenames", "test/worst_theta"}
        assert sum("loss/total" in row for row in run.history) == 1
    assert all((job / "csv" / "metrics.csv").is_file() for job in folders)


@pytest.mark.slow
@pytest.mark.usefixtures("cache")
def test_multirun_yields_a_wandb_run_and_results_per_job(tmp_path: Path) -> None:
    chosen = "narrow_road,lane_change", "hno,sno", "tanh"
    printed = multirun(tmp_path, *map("=".join, zip(("game", "operator", "activation"), chosen, strict=True)))
    check_jobs(tmp_path, *chosen)
    assert printed.count("W&B runs offline: no API key") == 4


@pytest.mark.slow
@pytest.mark.usefixtures("cache")
def test_the_whole_multirun_of_the_documentation(tmp_path: Path) -> None:
    chosen = "narrow_road,lane_change,drone", "hno,sno", "tanh,sin,relu"
    multirun(tmp_path, *map("=".join, zip(("game", "operator", "activation"), chosen, strict=True)))
    check_jobs(tmp_path, *chosen)


def test_a_failed_run_is_finished_too(command: Command) -> None:
    run = command("train", *SMOKE, "logger=wandb", "optimizer.lr=1e30")
    assert run.code == 1
    assert wandb.run is None
    kept = offline_run(run.folder)
    assert kept.exit_code == 1
    assert kept.summary["status"] == "failed"
    assert kept.summary["reason"] == run.results["reason"]
    assert run.text.count("W&B runs offline: no API key") == 1
    assert run.results["status"] == "failed"


def test_an_evaluation_is_a_run_of_its_own_kind(command: Command, random_checkpoint: Path) -> None:
    """With numbers, the table and its files, but no learning curve."""
    words = "theta=1,1", "unseen=[]", "starts=2", "dt=0.25", "residuals=false", "tags=[a,b]", "notes=why"
    run = command("evaluate", f"checkpoint={random_checkpoint}", *words, "logger=wandb", "workers=1")
    assert run.code == 0, run.text
    kept = offline_run(run.folder)
    assert (kept.job, kept.tags, kept.notes, kept.exit_code) == ("evaluate", ["a", "b"], "why", 0)
    assert kept.config["checkpoint"] == [str(random_checkpoint)]
    expected = {**numbers(run.results), "status": "finished", "reason": None}
    assert {name: kept.summary[name] for name in expected} == expected
    assert not any("loss" in name for row in kept.history for name in row)
    assert {"results.json", random_checkpoint.name, "episodes.json", "outcomes.json"} <= kept.files


@pytest.mark.usefixtures("no_labels")
def test_a_refused_job_of_a_sweep_is_a_run_that_says_why(tmp_path: Path, command: Command) -> None:
    sweep = f"hydra.sweep.dir={tmp_path}"
    done = command("train", "-m", "experiment=smoke", "logger=wandb,csv", "evaluation.dt=-1", sweep, folder="none")
    assert done.code == 1, done.text
    first, second = sorted(path.parent for path in tmp_path.glob("*/results.json"))
    kept = offline_run(first)
    assert (kept.job, kept.exit_code, kept.summary["status"]) == ("train", 1, "failed")
    assert "evaluation.dt must be greater than 0" in kept.summary["reason"]
    assert "results.json" in kept.files
    assert wandb.run is None
    assert not (second / "wandb").exists()


def test_disabled_wandb_leaves_nothing(command: Command) -> None:
    run = command("train", *SMOKE, "logger=wandb", "logger.mode=disabled", "trainer.max_steps=1")
    assert run.code == 0, run.text
    assert not (run.folder / "wandb").exists()
    assert (run.folder / "csv" / "metrics.csv").is_file()


@pytest.mark.usefixtures("no_labels")
def test_unknown_mode(command: Command) -> None:
    run = command("train", *SMOKE, "logger=wandb", "logger.mode=onlin")
    assert run.code == 2
    assert "logger.mode must be 'auto', 'disabled', 'offline' or 'online'; got 'onlin'" in run.text


@pytest.mark.parametrize("mode", ["disabled", "offline", "online"])
def test_a_chosen_mode_is_taken(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
    assert wandb_mode(mode) == mode


def test_online_needs_a_key() -> None:
    with pytest.raises(ValueError, match="no API key"):
        wandb_mode("online")


def test_without_a_key_offline_and_one_line(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        assert wandb_mode("auto") == "offline"
    assert [record.getMessage().split(".")[0] for record in caplog.records] == ["W&B runs offline: no API key"]


@pytest.fixture
def key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
    monkeypatch.setenv("WANDB_BASE_URL", "http://127.0.0.1:9")


@pytest.mark.usefixtures("key")
def test_without_network_offline_and_one_line(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        assert wandb_mode("auto") == "offline"
    assert ["cannot be reached" in record.getMessage() for record in caplog.records] == [True]


@pytest.mark.usefixtures("key")
def test_with_key_and_network_online(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logs, "_reachable", lambda url: True)
    assert wandb_mode("auto") == "online"


def test_the_environment_decides_where_the_configuration_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WANDB_MODE", "disabled")
    assert wandb_mode("auto") == "disabled"
    assert wandb_mode("offline") == "offline"
