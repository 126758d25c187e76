"""Conditions, and what they do to policies whose episodes are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pytest
import torch
from rich.console import Console
from torch import Tensor

from hno.cli.sections import show_section
from hno.control.rollout import Disturbance
from hno.evaluation.conditions import Condition, read_conditions
from hno.evaluation.robustness import Robustness
from hno.games import make
from hno.types import Extremal
from tests.fakes import evaluation_of, fake_labels, played_table
from tests.walkers import Walkers


def labelled(heights: Sequence[float], theta: float = 1.0, clearance: float = 0.5) -> Extremal:
    start = torch.tensor([[[0.0, y], [0.0, y]] for y in heights])
    return fake_labels(Walkers(), (theta, theta), len(heights), 0, None, [clearance] * len(heights), start)


def straight(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
    """Walkers of one height miss each other by twice that."""
    return torch.tensor([4.0, 0.0]).expand(len(x), 2, 2)


def rows_of(labels: Sequence[Extremal], conditions: Mapping[str, Any], dt: float = 0.02) -> list[dict[str, Any]]:
    """Lines of the section for walkers who go straight, from the same labels under every condition."""
    return Robustness().compute(evaluation_of(Walkers(), straight, labels, conditions=conditions, dt=dt))


SETS = [labelled([0.9, 0.05, 0.8]), labelled([0.9, 0.7], theta=2.0)]


def test_the_undisturbed_line_repeats_the_played_table() -> None:
    (row,) = rows_of(SETS, {"nothing": {}})
    table = played_table(Walkers(), straight, SETS, [])
    assert (row["safe_starts"], row["collisions"], row["rate"]) == (5, 1, 0.2)
    assert row["types"] == [
        {"theta": entry.theta, "safe_starts": entry.outcome.safe_starts, "collisions": entry.outcome.collisions}
        for entry in table
    ]
    assert row["interval"][0] < 0.2 < row["interval"][1]
    label_costs = torch.cat([-found.value[:, 0].sum(-1) for found in SETS])
    assert row["median_label_cost"] == label_costs.median().item()


def test_every_condition_plays_the_labels_of_its_width_and_its_own_disturbance() -> None:
    asked: list[float] = []

    def labels_of(condition: Condition) -> list[Extremal]:
        asked.append(condition.widen)
        return [labelled([0.9] * (3 if condition.widen == 1 else 4))]

    conditions = {"plain": {}, "wide": {"widen": 2.0}, "pushed": {"drift": 0.4}}
    evaluation = evaluation_of(Walkers(), straight, [labelled([0.9])], conditions=conditions, dt=0.1, solve=labels_of)
    plain, wide, pushed = Robustness().compute(evaluation)
    assert asked == [1.0, 2.0, 1.0]
    assert (plain["safe_starts"], wide["safe_starts"], pushed["safe_starts"]) == (3, 4, 3)
    assert [row["condition"] for row in (plain, wide, pushed)] == [{}, {"widen": 2.0}, {"drift": 0.4}]
    assert plain["median_excess_cost"] != pushed["median_excess_cost"]


def test_without_safe_starts_there_are_no_rates() -> None:
    nothing = [labelled([0.9, 0.05], clearance=-1.0)]  # the second one collides, as its equilibrium does
    (row,) = rows_of(nothing, {"any": {}}, 0.1)
    assert (row["safe_starts"], row["collisions"]) == (0, 0)
    for name in ("rate", "interval", "median_excess_cost", "median_label_cost"):
        assert row[name] is None


def test_entries_replace_those_of_the_table() -> None:
    base = Condition("", 1.5, disturbance=Disturbance(noise=0.1, delay=1, seed=7))
    content = {
        "same": {},
        "wide": {"widen": 2},
        "alike": {"symmetric": True},
        "tied": {"ties": True},
        "wind": {"drift": 0.1, "components": [0, 1], "noise": 0},
    }
    assert read_conditions(make("narrow_road"), content, base) == [
        Condition("same", 1.5, disturbance=base.disturbance),
        Condition("wide", 2.0, disturbance=base.disturbance),
        Condition("alike", 1.5, True, disturbance=base.disturbance),
        Condition("tied", 1.5, ties=True, disturbance=base.disturbance),
        Condition("wind", 1.5, disturbance=Disturbance(0, 1, 7, drift=0.1, components=(0, 1))),
    ]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "conditions must be names with entries"),
        ({}, "conditions must be names with entries"),
        ({"a": 0.2}, r"conditions.a must be entries such as \{noise: 0.2\}; got 0.2"),
        ({"a": {"noisy": 1}}, r"conditions.a.noisy does not exist.*Did you mean 'noise'"),
        ({"a": {"seed": 1}}, "conditions.a.seed does not exist"),
        ({"a": {"noise": -0.1}}, "conditions.a.noise must be a finite number of at least 0; got -0.1"),
        ({"a": {"gusts": float("nan")}}, "conditions.a.gusts must be a finite number"),
        ({"a": {"drift": "strong"}}, "conditions.a.drift must be a finite number"),
        ({"a": {"belief": True}}, "conditions.a.belief must be a finite number"),
        ({"a": {"learns": "median"}}, "conditions.a.learns must be mean, mode, expectation or null; got 'median'"),
        ({"a": {"learns": True}}, "conditions.a.learns must be mean, mode, expectation or null; got True"),
        ({"a": {"learns": "mode", "belief": 0.5}}, "conditions.a.learns and conditions.a.belief exclude each other"),
        ({"a": {"delay": 0.5}}, "conditions.a.delay must be a whole number"),
        ({"a": {"widen": 0}}, "conditions.a.widen must be a positive number; got 0"),
        ({"a": {"symmetric": 1}}, "conditions.a.symmetric must be true or false; got 1"),
        ({"a": {"components": 2}}, "conditions.a.components must be a list of places"),
        ({"a": {"components": [4]}}, r"0 to 3; got \[4\]"),
    ],
)
def test_impossible_conditions(content: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_conditions(make("narrow_road"), content, Condition("base"))


def test_without_a_collision_no_type_is_the_worst(capsys: pytest.CaptureFixture[str]) -> None:
    for heights, worst in (([0.9, 0.8], "none"), ([0.9, 0.05], "1 of 2 at (1, 1)")):
        (row,) = rows_of([labelled(heights)], {"all": {}}, 0.1)
        show_section("robustness", [row], {}, Console(width=140))
        assert worst in capsys.readouterr().out
