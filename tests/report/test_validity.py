"""From where a headline's rate holds."""

from __future__ import annotations

from typing import Any

import numpy as np

from hno.report.page import render
from hno.report.records import Run
from hno.report.runs import load
from hno.report.validity import validity
from tests.report.folders import GRID5, make_results, row, write_run


def run(**entries: Any) -> Run:
    return Run.model_validate({"status": "finished", "table": [], **entries})


def condition(collisions: int, starts: int, **entries: Any) -> dict[str, Any]:
    return row((1.0, 5.0), collisions, starts) | {"name": "any", "condition": entries, "types": []}


def test_it_names_the_start_box_and_the_clearance() -> None:
    assert validity([run()]) == "Valid from the start box, where an equilibrium keeps 0.02 m."
    said = validity([run(widen=2.0, clearance=0.5, constraint_unit="")])
    assert said == "Valid from a start box 2 times as wide as the game's, where an equilibrium keeps 0.5."


def test_rates_from_wider_boxes_are_pooled_over_runs_and_those_under_other_conditions_are_not_there() -> None:
    rows = [condition(3, 100, widen=2.0), condition(9, 100, widen=4), condition(50, 100, widen=2.0, noise=0.1)]
    said = validity([run(robustness=rows), run(robustness=[condition(1, 100, widen=2.0)]), run()])
    assert "2 times as wide: 2.00 % of 200 (0.55 to 5.04 %)." in said
    assert "4 times as wide: 9.00 % of 100" in said
    assert "50" not in said


def test_errors_off_the_labels_are_means_over_times_to_go() -> None:
    rows = [{"region": "PDE box", "relative_value": value} for value in (0.5, 1.5, None)]
    assert validity([run(off_labels=[*rows, "damaged"])]).endswith("Value error relative to its size: PDE box 100 %.")
    assert "error" not in validity([run(off_labels={"no": "list"})])


def test_the_headline_says_it(tmp_path) -> None:
    write_run(tmp_path / "one", make_results("drone", "sno", "tanh", 0, np.random.default_rng(0), GRID5[:1]))
    assert "Valid from the start box, where an equilibrium keeps 0.02 m." in render(load(tmp_path))
