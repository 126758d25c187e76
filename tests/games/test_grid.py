from __future__ import annotations

import itertools

import pytest

from hno.games import make
from hno.games.base import ExtrapolationWarning
from hno.games.grid import parse_types


@pytest.mark.parametrize(("name", "step"), [("grid5", 1.0), ("grid9", 0.5)])
def test_named_grids_span_the_type_box(name: str, step: float) -> None:
    axis = [1 + step * k for k in range(round(4 / step) + 1)]
    assert parse_types(make("narrow_road"), name) == list(itertools.product(axis, axis))


@pytest.mark.parametrize("text", ["1,1;2.5,4", " 1, 1 ; 2.50,4e0"])
def test_lists_of_types(text: str) -> None:
    assert parse_types(make("narrow_road"), text) == [(1.0, 1.0), (2.5, 4.0)]


@pytest.mark.parametrize("text", ["", "grid7", "everything", "1;one", "1,1;", ";1,1", "1,,1", "[1,1]"])
def test_other_words_are_answered_with_what_is_known(text: str) -> None:
    with pytest.raises(ValueError, match=r"grid5, grid9, or a list such as '1,1;2\.5,4'"):
        parse_types(make("narrow_road"), text)


@pytest.mark.parametrize("text", ["1", "1,1,1", "1,1;2", "1,nan", "inf,1"])
def test_types_are_one_finite_number_per_player(text: str) -> None:
    with pytest.raises(ValueError, match="2 finite numbers, one per player"):
        parse_types(make("narrow_road"), text)


def test_types_outside_the_range_warn() -> None:
    with pytest.warns(ExtrapolationWarning, match="extrapolate"):
        assert parse_types(make("narrow_road"), "6,1") == [(6.0, 1.0)]
