"""Sweeps whose jobs run in other processes."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.conftest import SMOKE, clean_globals, command, no_pages  # noqa: F401  # fixtures
from tests.cli.conftest import Command as Run

LAUNCHERS = {
    "joblib": ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2"),
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


def test_a_launcher_that_is_not_there_is_named_with_its_package(command: Run, tmp_path: Path) -> None:  # noqa: F811
    run = command("train", "-m", *SMOKE, "seed=0,1", "hydra/launcher=ray", f"hydra.sweep.dir={tmp_path}/sweep")
    assert run.code == 2
    assert "No hydra/launcher named 'ray'" in run.text
    assert "pip install hydra-ray-launcher" in run.text
    assert not (tmp_path / "sweep").exists()
