"""Start states and labels of conditions."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from hno.control.rollout import Disturbance
from hno.data.labels import Request, label_set, start_states
from hno.evaluation.conditions import ENTRIES, Condition, read_condition
from hno.games import make

REQUEST = Request((1.0, 5.0), 6, 0, "train")
SYMMETRIC = REQUEST._replace(symmetric=True)


@pytest.mark.parametrize("name", ["narrow_road", "drone"])
def test_symmetric_starts_are_those_of_the_first_player_for_all(name: str) -> None:
    game = make(name)
    found = start_states(game, SYMMETRIC)
    assert torch.equal(found[:, 0], found[:, 1])
    assert torch.equal(found[:, 0], start_states(game, REQUEST)[:, 0])
    assert bool(game.initial_box.contains(found).all())


def test_symmetric_starts_need_interchangeable_players() -> None:
    with pytest.raises(ValueError, match=r"players of one role; LaneChange has roles \(0, 1\)"):
        start_states(make("lane_change"), SYMMETRIC)


@pytest.mark.parametrize(
    ("name", "key"),
    [("narrow_road", "38d9eb1aa455b8a7"), ("lane_change", "1bcb473d32ccb627"), ("drone", "feeb4d23b526c971")],
)
def test_labels_that_were_solved_before_there_were_symmetric_starts_are_found(
    tmp_path: Path, name: str, key: str
) -> None:
    assert label_set(make(name), REQUEST, tmp_path).folder.name == f"1-5_train0_{key}"


def test_symmetric_starts_have_labels_of_their_own(tmp_path: Path) -> None:
    game = make("narrow_road")
    assert label_set(game, SYMMETRIC, tmp_path).folder != label_set(game, REQUEST, tmp_path).folder


def test_a_condition_says_what_is_unusual_about_it() -> None:
    entries = {"symmetric": True, "widen": 2, "noise": 0.2, "delay": 3, "components": [1], "learns": "mean"}
    condition = read_condition(make("narrow_road"), entries, Condition("any", disturbance=Disturbance(seed=7)))
    assert condition.entries() == entries | {"components": (1,)}
    assert condition.starts == (2, True, False)
    assert condition.disturbance.seed == 7
    assert Condition("usual").entries() == {}


def test_entries_of_a_condition_are_those_of_starts_and_disturbances() -> None:
    assert set(ENTRIES) == {"widen", "symmetric", "ties", *Disturbance._fields} - {"seed"}
