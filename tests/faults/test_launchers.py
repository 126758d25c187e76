"""Sweeps whose jobs run in other processes."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest
import torch

from hno.training.optimizers import optimizers
from tests.cli.conftest import SMOKE, clean_globals, command, no_pages  # noqa: F401  # fixtures
from tests.cli.conftest import Command as Run

LAUNCHERS = {
    "joblib": ("launcher=joblib", "launcher.n_jobs=2"),
    "submitit": ("hydra/launcher=submitit_local", "hydra.launcher.timeout_min=5"),
}


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_a_refused_job_makes_the_exit_code_of_its_sweep(command: Run, tmp_path: Path, launcher: str) -> None:  # noqa: F811
    pytest.importorskip(f"hydra_plugins.hydra_{launcher}_launcher")
    words = ("operator=sno", "loss.weights.residual=0.1", "seed=0,1", f"hydra.sweep.dir={tmp_path}/a b=(c)")
    run = command("train", "-m", *SMOKE, *words, *LAUNCHERS[launcher])
    assert run.code == 1, run.text
    assert "2 jobs" in run.text
    assert run.text.count("needs a weight and every weight a term") >= 2
    assert f"Page: {tmp_path}/a b=(c)" in run.text
    assert not list((tmp_path / "a b=(c)").glob(".jobs-*"))


def killing(parameters: object, lr: float = 1.0) -> None:
    """An optimiser in whose place the process is killed, as the operating system does for lack of memory."""
    os.kill(os.getpid(), signal.SIGKILL)


def sgd(parameters: Any, lr: float = 1.0) -> torch.optim.Optimizer:
    """One that nobody kills."""
    return torch.optim.SGD(parameters, lr=lr)


@pytest.mark.slow
def test_a_worker_that_is_killed_ends_the_sweep_with_the_likely_reason(
    command: Run,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    optimizers.names()
    monkeypatch.setattr(optimizers, "_classes", dict(optimizers._classes))
    optimizers.register("killing")(killing)
    words = ("optimizer=killing", "seed=0,1", f"hydra.sweep.dir={tmp_path}/sweep")
    run = command("train", "-m", *SMOKE, *words, *LAUNCHERS["joblib"])
    assert run.code == 1, run.text
    assert "The launcher ended before all jobs did: " in run.text
    assert "excessive memory usage" in run.text
    assert "Traceback" not in run.text
    assert f"Page: {tmp_path}/sweep" in run.text
    optimizers._classes["killing"] = sgd  # type: ignore[assignment]  # as if mended
    again = command("train", f"sweep={tmp_path}/sweep", folder="none")
    assert again.code == 0, again.text
    assert again.text.count("finished, repeated") == 2, "they were killed before their first checkpoint"


def test_a_launcher_that_is_not_there_is_named_with_its_package(command: Run, tmp_path: Path) -> None:  # noqa: F811
    run = command("train", "-m", *SMOKE, "seed=0,1", "hydra/launcher=ray", f"hydra.sweep.dir={tmp_path}/sweep")
    assert run.code == 2
    assert "No hydra/launcher named 'ray'" in run.text
    assert "pip install hydra-ray-launcher" in run.text
    assert not (tmp_path / "sweep").exists()
