from __future__ import annotations

import pytest

from hno.evaluation.metrics import clopper_pearson
from hno.report.totals import totals
from tests.report.tables import type_row


def test_counts_add_and_the_worst_type_is_that_of_the_highest_rate_not_count() -> None:
    whole = totals([type_row((1, 1), 3, 300), type_row((1, 5), 2, 20), type_row((5, 5), 0, 80)])
    assert (whole.collisions, whole.safe_starts, whole.rate) == (5, 400, 5 / 400)
    assert whole.interval == clopper_pearson(5, 400)
    assert (whole.worst_theta, whole.worst_rate) == ((1, 5), 0.1)


def test_where_nothing_collides_no_type_is_the_worst() -> None:
    whole = totals([type_row((1, 1), 0, 300), type_row((1, 5), 0, 20)])
    assert (whole.worst_theta, whole.worst_rate, whole.rate) == (None, 0, 0)


def test_excess_is_relative_to_the_equilibrium_and_negative_costs_keep_its_sign() -> None:
    table = [type_row((1, 1), 0, 9, 1.0, 10.0), type_row((1, 2), 0, 9, 3.0, -10.0), type_row((1, 3), 0, 9, -2.0, 10.0)]
    assert totals(table).excess == pytest.approx(0.1)
    assert totals(table[1:2]).excess == pytest.approx(0.3)


def test_types_without_safe_starts_count_for_nothing() -> None:
    table = [type_row((1, 1), 1, 10), type_row((5, 5), 0, 0)]
    assert totals(table) == totals(table[:1])


@pytest.mark.parametrize("name", ["median_excess_cost", "median_label_cost"])
def test_costs_that_were_not_finite_are_null_and_leave_the_others(name: str) -> None:
    table = [type_row((1, 1), 0, 9, 1.0, 10.0), type_row((1, 2), 0, 9) | {name: None}]
    assert totals(table).excess == pytest.approx(0.1)


@pytest.mark.parametrize("table", [[], [type_row((5, 5), 0, 0)]])
def test_what_does_not_exist_is_none(table: list[dict[str, object]]) -> None:
    assert totals(table) == (0, 0, None, None, None, None, None)
