from __future__ import annotations

import itertools

import pytest

from hno.data.curriculum import Curriculum


def test_window_widens_linearly_from_the_terminal_time_to_the_horizon() -> None:
    curriculum = Curriculum(start=100, length=50)
    shares = [curriculum.window(step) for step in range(100, 150)]
    widening = [after - before for before, after in itertools.pairwise(shares)]
    assert widening == pytest.approx([1 / 50] * 49)
    assert shares[0] == pytest.approx(1 / 50)
    assert shares[-1] == 1.0


def test_window_is_shut_before_and_open_after() -> None:
    curriculum = Curriculum(start=100, length=50)
    assert not curriculum.active(99)
    assert curriculum.window(99) == 0.0
    assert curriculum.active(100)
    assert curriculum.window(10_000) == 1.0


def test_window_is_shut_again_at_the_end() -> None:
    curriculum = Curriculum(start=100, length=50, end=120)
    assert curriculum.window(119) == pytest.approx(20 / 50)
    assert curriculum.active(119)
    assert not curriculum.active(120)
    assert curriculum.window(120) == 0.0


def test_window_depends_on_the_step_alone() -> None:
    curriculum = Curriculum(start=3, length=7)
    assert [curriculum.window(step) for step in (9, 4, 9)] == [curriculum.window(step) for step in (9, 4, 9)]
    assert curriculum == Curriculum(3, 7)


def test_without_a_length_the_window_opens_at_once() -> None:
    assert Curriculum(start=5, length=0).window(5) == 1.0
