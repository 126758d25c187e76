"""Conditions, and what they do to policies whose episodes are known."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch
from rich.console import Console
from torch import Tensor

from hno.cli.tables import show_section
from hno.control.rollout import Disturbance
from hno.evaluation.closed_loop import collision_table
from hno.evaluation.conditions import Condition, read_conditions
from hno.evaluation.robustness import robustness_table
from hno.games import make
from hno.types import Extremal
from tests.fakes import fake_labels
from tests.walkers import Walkers


def labelled(heights: Sequence[float], theta: float = 1.0, clearance: float = 0.5) -> Extremal:
    start = torch.tensor([[[0.0, y], [0.0, y]] for y in heights])
    return fake_labels(Walkers(), (theta, theta), len(heights), 0, None, [clearance] * len(heights), start)


def straight(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
    """Walkers of one height miss each other by twice that."""
    return torch.tensor([4.0, 0.0]).expand(len(x), 2, 2)


SETS = [labelled([0.9, 0.05, 0.8]), labelled([0.9, 0.7], theta=2.0)]


def test_the_undisturbed_line_repeats_the_collision_table() -> None:
    (row,) = robustness_table(Walkers(), straight, [Condition("nothing")], lambda condition: SETS, 0.02, 0.02)
    table = collision_table(Walkers(), straight, SETS, [])
    assert (row.outcome.safe_starts, row.outcome.collisions, row.outcome.rate) == (5, 1, 0.2)
    assert row.types == [
        {"theta": entry.theta, "safe_starts": entry.outcome.safe_starts, "collisions": entry.outcome.collisions}
        for entry in table
    ]
    assert row.outcome.interval is not None
    assert row.outcome.interval[0] < 0.2 < row.outcome.interval[1]
    label_costs = torch.cat([-found.value[:, 0].sum(-1) for found in SETS])
    assert row.outcome.median_label_cost == label_costs.median().item()


def test_every_condition_plays_the_labels_of_its_width_and_its_own_disturbance() -> None:
    asked: list[float] = []

    def labels_of(condition: Condition) -> list[Extremal]:
        asked.append(condition.widen)
        return [labelled([0.9] * (3 if condition.widen == 1 else 4))]

    conditions = [
        Condition("plain"),
        Condition("wide", 2.0),
        Condition("pushed", disturbance=Disturbance(drift=0.4, seed=1)),
    ]
    plain, wide, pushed = robustness_table(Walkers(), straight, conditions, labels_of, 0.02, 0.1)
    assert asked == [1.0, 2.0, 1.0]
    assert (plain.outcome.safe_starts, wide.outcome.safe_starts, pushed.outcome.safe_starts) == (3, 4, 3)
    assert [row.content()["condition"] for row in (plain, wide, pushed)] == [{}, {"widen": 2.0}, {"drift": 0.4}]
    assert plain.outcome.median_excess_cost != pushed.outcome.median_excess_cost


def test_without_safe_starts_there_are_no_rates() -> None:
    nothing = [labelled([0.9, 0.05], clearance=-1.0)]  # the second one collides, as its equilibrium does
    (row,) = robustness_table(Walkers(), straight, [Condition("any")], lambda condition: nothing, 0.02, 0.1)
    assert (row.outcome.safe_starts, row.outcome.collisions) == (0, 0)
    found = row.outcome
    assert (found.rate, found.interval, found.median_excess_cost, found.median_label_cost) == (None,) * 4


def test_entries_replace_those_of_the_table() -> None:
    base = Condition("", 1.5, disturbance=Disturbance(noise=0.1, delay=1, seed=7))
    content = {
        "same": {},
        "wide": {"widen": 2},
        "alike": {"symmetric": True},
        "wind": {"drift": 0.1, "components": [0, 1], "noise": 0},
    }
    assert read_conditions(make("narrow_road"), content, base) == [
        Condition("same", 1.5, disturbance=base.disturbance),
        Condition("wide", 2.0, disturbance=base.disturbance),
        Condition("alike", 1.5, True, base.disturbance),
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
        labels = [labelled(heights)]
        rows = robustness_table(Walkers(), straight, [Condition("all")], lambda _, labels=labels: labels, 0.02, 0.1)
        show_section("robustness", [row.content() for row in rows], {}, Console(width=140))
        assert worst in capsys.readouterr().out
