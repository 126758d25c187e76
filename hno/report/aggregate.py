"""Runs of one recipe with several seeds as one line: pooled counts, the spread over seeds, and the best of a game."""

from __future__ import annotations

import functools
import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from scipy.stats import t as student

from hno.evaluation.metrics import clopper_pearson
from hno.report.parsing import TypeResult, number
from hno.report.runs import NOT_AVAILABLE, Run
from hno.report.totals import relative_excess

CONFIDENCE = 0.95
"""Of every interval."""


class Rate(NamedTuple):
    """Collisions of safe starts."""

    collisions: int
    starts: int

    @property
    def value(self) -> float | None:
        """Collisions per start; None without starts."""
        return self.collisions / self.starts if self.starts else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """Clopper-Pearson interval, episodes taken as independent; None without starts."""
        return _interval(self.collisions, self.starts)


@functools.cache
def _interval(collisions: int, starts: int) -> tuple[float, float] | None:
    return clopper_pearson(collisions, starts, CONFIDENCE)


class Spread(NamedTuple):
    """A number over seeds."""

    mean: float
    interval: tuple[float, float] | None
    """Student's t interval of the mean; None for one seed."""
    low: float
    high: float
    seeds: int


Comparable = tuple[str, str, frozenset[tuple[float, ...]]]
"""Game, what is special, and types."""


class Recipe(NamedTuple):
    """Runs that differ in their seed only."""

    game: str
    operator: str
    activation: str
    variant: str
    """Settings in which it differs from others of the same names; empty if there are none."""
    special: str
    """Changed constants of the game and how episodes were played, as far as that is not usual; empty if it is."""
    runs: tuple[Run, ...]
    """One finished run for every seed."""
    repeated: tuple[Run, ...]
    """Finished runs of a seed that a later run repeats; they do not count."""
    unfinished: int
    failed: int

    @property
    def name(self) -> str:
        """Operator, activation and what else is special."""
        return " / ".join(filter(None, (self.operator, self.activation, self.variant)))

    @property
    def conditions(self) -> str:
        """At how many types episodes were played, and what was special."""
        sizes = sorted({len(run.table) for run in self.runs})
        at = f"{' or '.join(map(str, sizes))} types" if sizes else NOT_AVAILABLE
        return ", ".join(filter(None, (at, self.special)))

    @property
    def comparable(self) -> Comparable:
        """What recipes share whose numbers may be compared: the game with its constants, play, and the very types."""
        return self.game, self.special, frozenset(row.theta for run in self.runs for row in run.table)

    @property
    def rate(self) -> Rate:
        """Counts over all types and seeds."""
        return total(row for run in self.runs for row in run.table)

    @property
    def rates(self) -> Spread | None:
        """Spread of the collision rate over seeds."""
        return spread(total(run.table).value for run in self.runs)

    @property
    def excess(self) -> Spread | None:
        """Spread of the relative excess cost over seeds."""
        return spread(excess(run.table) for run in self.runs)

    def seconds(self, part: str) -> Spread | None:
        """Spread of the time that a part took, s."""
        return spread(seconds(run, part) for run in self.runs)

    @property
    def table(self) -> list[TypeResult]:
        """One row for every type, counts pooled over seeds, the other numbers as means over seeds."""
        rows: dict[tuple[float, ...], list[TypeResult]] = defaultdict(list)
        for run in self.runs:
            for row in run.table:
                rows[row.theta].append(row)
        return [pool(found) for _, found in sorted(rows.items())]


def total(rows: Iterable[TypeResult]) -> Rate:
    """Counts over types."""
    counts = [(row.collisions, row.starts) for row in rows]
    return Rate(sum(c for c, _ in counts), sum(n for _, n in counts))


def pool(rows: Sequence[TypeResult]) -> TypeResult:
    """One type over seeds."""
    counted = total(rows)
    return TypeResult(
        rows[0].theta,
        any(row.seen for row in rows),
        *counted,
        distance=mean(row.distance for row in rows),
        excess=mean(row.excess for row in rows),
        label_cost=mean(row.label_cost for row in rows),
        extrapolated=any(row.extrapolated for row in rows),
    )


def mean(values: Iterable[float | None]) -> float | None:
    """Mean of the numbers that exist; None if there are none."""
    found = [value for value in values if value is not None]
    return math.fsum(found) / len(found) if found else None


def excess(rows: Iterable[TypeResult]) -> float | None:
    """Median over types of the median excess cost, relative to the median of the equilibria's costs."""
    return relative_excess((row.excess, row.label_cost) for row in rows)


def worst(rows: Iterable[TypeResult]) -> TypeResult | None:
    """The type with the highest collision rate; None without starts."""
    return max((row for row in rows if row.starts), key=lambda row: row.collisions / row.starts, default=None)


def spread(values: Iterable[float | None]) -> Spread | None:
    """Mean, t interval and range of the numbers that exist; None if there are none."""
    found = [value for value in values if value is not None]
    if not found:
        return None
    centre, count = math.fsum(found) / len(found), len(found)
    interval = None
    if count > 1:
        deviation = math.sqrt(math.fsum((value - centre) ** 2 for value in found) / (count - 1))
        half = float(student.ppf((1 + CONFIDENCE) / 2, count - 1)) * deviation / math.sqrt(count)
        interval = (centre - half, centre + half)
    return Spread(centre, interval, min(found), max(found), count)


def seconds(run: Run, part: str) -> float | None:
    """Time that a part of a run took, s; "total" is the sum of all."""
    parts = run.content.get("seconds")
    if not isinstance(parts, dict):
        return None
    known = [value for value in (number(entry) for entry in parts.values()) if value is not None]
    return (math.fsum(known) if known else None) if part == "total" else number(parts.get(part))


def best(found: Iterable[Recipe]) -> dict[Comparable, Recipe]:
    """The recipe with the lowest collision rate, then the lowest excess cost, of all that may be compared."""
    first: dict[Comparable, Recipe] = {}
    for recipe in found:
        key = recipe.comparable
        if recipe.rate.starts and (key not in first or _order(recipe) < _order(first[key])):
            first[key] = recipe
    return first


def _order(recipe: Recipe) -> tuple[float, float]:
    return recipe.rate.value or 0.0, math.inf if recipe.excess is None else recipe.excess.mean


def headline(found: Iterable[Recipe]) -> Recipe:
    """Of the best recipes of a game the one at its usual constants and conditions, then at the most types."""
    return min(found, key=lambda one: (bool(one.special), -len(one.comparable[2]), *_order(one)))


def rivals(chosen: Recipe, found: Iterable[Recipe]) -> list[Recipe]:
    """Recipes that may be compared with the chosen one and whose interval of the collision rate overlaps its own."""
    inside = chosen.rate.interval
    assert inside is not None
    return [
        recipe
        for recipe in found
        if recipe is not chosen
        and recipe.comparable == chosen.comparable
        and recipe.rate.interval is not None
        and recipe.rate.interval[0] <= inside[1]
    ]
