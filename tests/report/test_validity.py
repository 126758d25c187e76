"""From where a headline's rate holds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hno.evaluation.starts import Starts, starts_from
from hno.report.clearances import curves
from hno.report.page import render
from hno.report.recipes import recipes
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


def kept(
    theta: tuple[float, ...], clearance: list[float | None], label: list[float]
) -> dict[tuple[float, ...], Starts]:
    collided = "".join("1" if one is None or one <= 0 else "0" for one in clearance)
    return {theta: Starts(theta, "key", "1" * len(label), collided, tuple(clearance), tuple(label))}


def test_the_rate_by_the_clearance_of_the_equilibrium_is_that_of_its_quarters() -> None:
    near = run(outcomes=kept((1.0, 1.0), [-0.1, None, 0.2, 0.3, 1.0, 1.0, 2.0, 2.0], [0.1, 0.1, 0.2, 0.3, 1, 1, 2, 2]))
    said = (
        "By the clearance of the equilibrium: 100.00 % of 2 where it is up to 0.18 m, 0.00 % of 2 where it is 1.25 or"
    )
    assert said in validity([near]).replace("\u00a0", " ")
    assert "By the clearance" not in validity([run()])


def test_curves_begin_at_what_collides_and_end_at_all() -> None:
    """At 0 the share is the collision rate, it never falls with d, and equilibria of safe starts never collide."""
    rng = np.random.default_rng(0)
    label = (0.02 + rng.gamma(2, 0.4, 40)).tolist()
    played = [*(-rng.gamma(2, 0.1, 4)).tolist(), None, *(rng.gamma(2, 0.4, 35) + 0.01).tolist()]
    results = make_results("drone", "sno", "tanh", 0, np.random.default_rng(0), GRID5[:1])
    whole = run(**results | {"table": [row((1.0, 1.0), 5, 40)]}, outcomes=kept((1.0, 1.0), played, label))
    other = run(**results | {"table": [row((1.0, 1.0), 5, 40)], "game": "own"})
    (curve,) = curves(recipes([whole, other]))
    at = curve["d"].index(0.0)
    assert (curve["share"][at], curve["label"][at]) == (5 / 40, 0.0)
    assert curve["game"] == "drone"
    for name in ("share", "label"):
        assert curve[name] == sorted(curve[name])
    assert curve["label"][-1] >= 0.9


def test_clearances_of_another_number_than_the_starts_are_refused() -> None:
    (one,) = kept((1.0, 1.0), [0.1, 0.2], [0.1, 0.3]).values()
    assert starts_from(one._asdict()) == one
    with pytest.raises(ValueError, match="clearances must be one per start"):
        starts_from(one._asdict() | {"clearance": [0.1]})
    with pytest.raises(ValueError, match="expected theta"):
        starts_from(one._asdict() | {"clearance": [{}, 1]})


def test_the_headline_says_it(tmp_path) -> None:
    write_run(tmp_path / "one", make_results("drone", "sno", "tanh", 0, np.random.default_rng(0), GRID5[:1]))
    assert "Valid from the start box, where an equilibrium keeps 0.02 m." in render(load(tmp_path))
