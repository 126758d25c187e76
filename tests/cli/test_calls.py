"""Commands as Python calls."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import hno
from hno.games import make

TINY = {
    "experiment": "smoke", "data.types": [[1, 1]], "data.workers": 1, "evaluation.dt": 0.1, "trainer.max_steps": 2,
}  # fmt: skip


@pytest.mark.usefixtures("cache", "clean_globals")
def test_training_and_evaluation_as_calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each leaves the landscape of what it has, unless there is no folder whose page could show it."""
    monkeypatch.setattr("hno.evaluation.landscape.page_program", lambda operator: {"nodes": [], "outputs": {}})
    policy = hno.train(
        "narrow_road", "hno", tmp_path / "run", {**TINY, "activation": "tanh", "evaluation.landscape": True}
    )
    assert policy.names() == {"game": "narrow_road", "operator": "hno", "function": "potential", "activation": "tanh"}
    tau, theta = torch.tensor([3.0]), torch.ones(1, 2)
    x = policy.game.initial_box.sample(1, torch.Generator().manual_seed(0))
    assert policy.value(tau, x, theta).shape == (1, 2)
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    assert (results["status"], results["landscape"]) == ("finished", "landscape.js")
    assert (tmp_path / "run" / "landscape.js").exists()
    settings = {"theta": "1,1", "starts": 4, "workers": 1, "dt": 0.1, "residuals": False}
    found = hno.evaluate(tmp_path / "run", tmp_path / "evaluation", settings)
    assert (found["status"], found["landscape"]) == ("finished", "landscape.js")
    assert (tmp_path / "evaluation" / "landscape.js").exists()
    assert "landscape" not in hno.evaluate(tmp_path / "run", settings=settings)
    assert [row["theta"] for row in found["table"]] == [(1.0, 1.0)]


@pytest.mark.usefixtures("no_labels")
def test_a_game_keeps_its_constants_and_mistakes_are_errors(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"trainer\.max_step does not exist"):
        hno.train(make("narrow_road", radius=1.5), "hno", tmp_path, {**TINY, "trainer.max_step": 3})
    with pytest.raises(AssertionError, match="labels were asked for"):
        hno.train(make("narrow_road", radius=1.5), "hno", tmp_path, TINY)
    found = json.loads((tmp_path / "results.json").read_text())
    assert (found["status"], found["reason"]) == ("failed", "AssertionError: labels were asked for")


@pytest.mark.usefixtures("cache")
def test_a_training_prints_nothing(tmp_path: Path) -> None:
    code = f"import hno; hno.train('narrow_road', 'hno', {str(tmp_path)!r}, {TINY!r})"
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": str(Path(hno.__file__).parents[1])},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.usefixtures("no_labels")
def test_a_method_that_does_not_exist_is_answered_with_the_methods(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"^No method named 'hmo'\. Known: hno, sno.* Did you mean 'hno'\?$") as error:
        hno.train("narrow_road", "hmo", tmp_path, TINY)
    assert "potential" not in str(error.value)
