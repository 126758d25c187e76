"""The landscape of a model lies beside its results."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hno.cli.landscapes import write_landscape
from hno.cli.results import Results
from hno.control import Feedback
from hno.control.slices import Slice
from hno.evaluation.film import keep, shot
from hno.report.runs import load
from tests.cli.conftest import SMOKE, Command
from tests.operators.conftest import small_operator


@pytest.fixture
def evaluation(monkeypatch: pytest.MonkeyPatch) -> Any:
    """One whose graph is not traced, which takes seconds."""
    monkeypatch.setattr("hno.evaluation.landscape.page_program", lambda operator: {"nodes": [], "outputs": {}})
    policy = Feedback(small_operator("narrow_road").requires_grad_(False))
    return SimpleNamespace(policy=policy, options={"landscape": True, "landscape_truth": 0}, equilibria=None)


def written(folder: Path, name: str) -> dict[str, Any]:
    """What a landscape hands to the page."""
    text = (folder / name).read_text().strip()
    assert text.startswith("hnoLandscape(")
    return json.loads(text.removeprefix("hnoLandscape(").removesuffix(");"))


def test_it_has_the_plane_of_the_game_and_the_frames_of_the_training(evaluation: Any, tmp_path: Path) -> None:
    frame: Slice = shot(evaluation.policy)
    keep(frame, 10, tmp_path)
    results = Results(tmp_path / "results.json", {})
    assert write_landscape(evaluation, results) == {"landscape": "landscape.js"}
    content = written(tmp_path, "landscape.js")
    assert content["plane"]["across"] == {"name": "gap", "lo": -10.0, "hi": 40.0}
    assert [one["step"] for one in content["film"]["frames"]] == [10]
    assert content["truth"] is None
    assert results.content["seconds"]["landscape"] > 0
    assert write_landscape(evaluation, results, 2) == {"landscape": "landscape2.js"}
    results.update(status="finished", landscape="landscape.js")
    (run,) = load(tmp_path).runs
    assert run.landscape == tmp_path / "landscape.js"


def test_it_is_not_written_unasked(evaluation: Any, tmp_path: Path) -> None:
    evaluation.options["landscape"] = False
    assert write_landscape(evaluation, Results(tmp_path / "results.json", {})) == {}
    assert [path.name for path in tmp_path.iterdir()] == ["results.json"]


def test_a_game_without_a_slice_loses_no_results(evaluation: Any, tmp_path: Path, caplog, monkeypatch) -> None:
    monkeypatch.setattr(type(evaluation.policy.game), "state_names", ("one",))
    assert write_landscape(evaluation, Results(tmp_path / "results.json", {})) == {}
    assert "There is no landscape: NarrowRoad has 4 states per player" in caplog.text


def test_a_plane_of_one_point_is_refused_before_anything_is_solved(command: Command) -> None:
    run = command("train", *SMOKE, "evaluation.landscape_truth=1")
    assert run.code == 2
    assert "0 for none, or at least 2; got 1" in run.text
    assert not (run.folder / "results.json").exists()


@pytest.mark.slow
def test_a_training_writes_landscape_truth_film_and_errors_off_the_labels(command: Command) -> None:
    asked = "evaluation.landscape=true", "evaluation.landscape_truth=2", "evaluation.off_labels=1"
    run = command("train", *SMOKE, *asked)
    assert run.code == 0
    content = written(run.folder, run.results["landscape"])
    assert content["program"]["nodes"]
    assert content["truth"]["solved"] > 0
    assert [one["step"] for one in content["film"]["frames"]] == [5, 10]
    assert {row["region"] for row in run.results["off_labels"]} >= {"start box", "PDE box", "near the constraint"}
    assert "Errors off the labels" in run.text
