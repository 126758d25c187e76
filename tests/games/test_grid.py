from __future__ import annotations

import itertools

import pytest
import torch

from hno.games import make
from hno.games.base import ExtrapolationWarning
from hno.games.grid import parse_types
from tests.lq import random_game


@pytest.mark.parametrize(
    ("name", "step"), [("grid5", 1.0), ("grid9", 0.5), ("grid2", 4.0), ("corners", 4.0), ("grid17", 0.25)]
)
def test_named_grids_span_the_type_box(name: str, step: float) -> None:
    axis = [1 + step * k for k in range(round(4 / step) + 1)]
    assert parse_types(make("narrow_road"), name) == list(itertools.product(axis, axis))


@pytest.mark.parametrize("text", ["1,1;2.5,4", " 1, 1 ; 2.50,4e0"])
def test_lists_of_types(text: str) -> None:
    assert parse_types(make("narrow_road"), text) == [(1.0, 1.0), (2.5, 4.0)]


@pytest.mark.parametrize("text", ["", "grid1", "grid", "everything", "1;one", "1,1;", ";1,1", "1,,1", "[1,1]"])
def test_other_words_are_answered_with_what_is_known(text: str) -> None:
    with pytest.raises(ValueError, match=r"data.types must be one of corners, gridN .*or a list such as '1,1;2\.5,4'"):
        parse_types(make("narrow_road"), text)


@pytest.mark.parametrize("text", ["1", "1,1,1", "1,1;2", "1,nan", "inf,1"])
def test_types_are_one_finite_number_per_player(text: str) -> None:
    with pytest.raises(ValueError, match="2 finite numbers, one per player"):
        parse_types(make("narrow_road"), text)


def test_types_outside_the_range_warn() -> None:
    with pytest.warns(ExtrapolationWarning, match="extrapolate"):
        assert parse_types(make("narrow_road"), "6,1") == [(6.0, 1.0)]


def test_lists_are_taken_as_they_are_and_nothing_means_the_defaults_of_the_game() -> None:
    assert parse_types(make("drone"), [[1, 1], [2.5, 4]]) == [(1.0, 1.0), (2.5, 4.0)]
    assert parse_types(make("drone"), None) == make("drone").default_types()


@pytest.mark.parametrize("name", ["narrow_road", "lane_change", "drone"])
def test_default_types_of_two_players(name: str) -> None:
    assert make(name).default_types() == [(1, 1), (1, 5), (5, 1), (5, 5), (1, 3), (3, 3), (3, 5)]


@pytest.mark.parametrize("players", [1, 2, 3, 6])
def test_default_types_lie_in_the_type_box_and_their_number_grows_linearly(players: int) -> None:
    game = random_game(players)
    types = game.default_types()
    assert len(types) == len(set(types)) <= 3 * players + 1
    assert game.type_box.contains(torch.tensor(types)).all()
    assert {(0.0,) * players, (1.0,) * players, (0.5,) * players} <= set(types)


def test_errors_name_the_key() -> None:
    with pytest.raises(ValueError, match=r"validation.types must be one of default, corners, .*2 finite numbers"):
        parse_types(make("drone"), "1,2,3", key="validation.types", also=("default",))
