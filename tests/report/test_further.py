"""Sections of runs on a page of bounded size."""

from __future__ import annotations

import itertools

from hno.report.further import Further, fitting
from hno.report.tables import Cell, Row, Table

TEN = Table(["row"], [Row([Cell("0123456789" * 10)]) for _ in range(10)])


def entry(run: str) -> Further:
    return Further(run, {}, {"heading": TEN})


def rows_kept(budget: int) -> list[int]:
    """Of each entry that is kept."""
    return [len(one.tables["heading"].rows) for one in fitting([entry("first"), entry("second")], budget)]


def test_what_fits_is_kept_in_order() -> None:
    kept = [rows_kept(budget) for budget in range(0, 6000, 20)]
    assert kept[0] == []
    assert kept[-1] == [10, 10]
    assert all(sum(small) <= sum(large) for small, large in itertools.pairwise(kept))
    assert all(rows[0] == 10 for rows in kept if len(rows) == 2)
    cut = [rows for rows in kept if rows and rows[-1] < 10]
    assert {len(rows) for rows in cut} == {1, 2}
    assert {rows[-1] for rows in cut} == set(range(1, 10))


def test_a_table_that_was_cut_says_how_many_rows_there_are() -> None:
    (one,) = fitting([entry("first")], 1000)
    table = one.tables["heading"]
    assert 0 < len(table.rows) < 10
    assert table.total == 10
