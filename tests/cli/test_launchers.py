"""Launchers by short names."""

from __future__ import annotations

import subprocess
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from hno.cli import launchers
from hno.cli.arguments import UsageError, parse
from hno.cli.launchers import LAUNCHERS, check_cluster, keep_to, share, spelled
from hno.pontryagin.threads import cores
from tests.cli.conftest import SMOKE, Command

PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]


def test_every_launcher_that_is_no_part_of_hydra_has_an_extra_of_its_name() -> None:
    extras = PROJECT["optional-dependencies"]
    for name, launcher in LAUNCHERS.items():
        assert (launcher.module is None) or launcher.module.replace("_", "-") in "".join(extras[name])


def test_names_and_options_are_hydras(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launchers, "installed", lambda launcher: True)
    given = spelled(parse(["-m", "launcher=slurm", "launcher.partition=gpu", "seed=0,1", "launcher.cpus_per_task=4"]))
    assert given.overrides == [
        "hydra/launcher=submitit_slurm", "hydra.launcher.cpus_per_task=1", "hydra.launcher.partition=gpu", "seed=0,1",
        "hydra.launcher.cpus_per_task=4",
    ]  # fmt: skip
    untouched = parse(["game.constants.launcher=3", "hydra.launcher.n_jobs=2"])
    assert spelled(untouched) == untouched


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("-m", "launcher=rq"), "No launcher named 'rq'. Known: basic, joblib, slurm, ray."),
        (("-m", "launcher=basic,joblib"), "All jobs have the same one"),
        (("-m", "launcher=ray"), "launcher=ray needs packages that are not installed: pip install 'hno[ray]'."),
        (("launcher=basic",), "launcher= runs the jobs of a sweep: add -m"),
        (("launcher.n_jobs=2",), "launcher= runs the jobs of a sweep: add -m"),
    ],
)
def test_what_cannot_run_is_refused_before_any_work(
    command: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    monkeypatch.setattr(launchers, "installed", lambda launcher: launcher.module is None)
    monkeypatch.chdir(tmp_path)
    run = command("train", *SMOKE, "seed=0", *words, folder="none")
    assert (run.code, message in run.text) == (2, True), run.text
    assert list(tmp_path.iterdir()) == []


Composed = Callable[..., None]


@pytest.fixture
def composed(monkeypatch: pytest.MonkeyPatch) -> Composed:
    """What was composed last."""

    def tell(choice: str = "basic", **launcher: Any) -> None:
        hydra = OmegaConf.create({"runtime": {"choices": {"hydra/launcher": choice}}, "launcher": launcher})
        monkeypatch.setattr(HydraConfig, "get", lambda: hydra)

    return tell


def test_a_cluster_that_is_not_there_is_refused(composed: Composed, monkeypatch: pytest.MonkeyPatch) -> None:
    composed("joblib")
    monkeypatch.setattr(launchers.shutil, "which", lambda program: None)
    check_cluster()
    composed("submitit_slurm")
    with pytest.raises(UsageError, match="There is no Slurm on this machine"):
        check_cluster()
    monkeypatch.setattr(launchers.shutil, "which", lambda program: program)

    def silent(*words: object, **options: object) -> None:
        raise subprocess.CalledProcessError(1, "sinfo", stderr="sinfo: error: Unable to contact\n slurm controller")

    monkeypatch.setattr(launchers.subprocess, "run", silent)
    with pytest.raises(UsageError, match="does not answer: sinfo: error: Unable to contact slurm controller"):
        check_cluster()


def test_jobs_side_by_side_share_the_cores(composed: Composed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 8)
    monkeypatch.setattr("joblib.cpu_count", lambda: 8)
    composed()
    assert share() is None, "one after the other, each has all"
    for jobs, each in ((1, 8), (2, 4), (3, 2), (20, 1)):
        composed("joblib", n_jobs=jobs)
        assert share() == each
    composed("ray", ray={"remote": {"num_cpus": 3}})
    assert share() == 3
    composed("ray", ray={"remote": {}})
    assert share() == 1


def test_a_job_keeps_to_its_share(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "64")
    keep_to(None)
    before = cores()
    keep_to(1)
    assert cores() == 1 <= before


def test_the_help_names_them(command: Command) -> None:
    run = command("train", "--help")
    for name, launcher in LAUNCHERS.items():
        assert [line for line in run.text.splitlines() if f" {name} " in line and launcher.about in line]
