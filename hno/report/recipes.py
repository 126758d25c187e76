"""Runs that differ in their seed only as one recipe: pooled counts, the spread over seeds, and the best of a game."""

from __future__ import annotations

import functools
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from scipy.stats import t as student

from hno.evaluation.format import NOT_AVAILABLE, counted
from hno.evaluation.outcome import Pooled, pooled
from hno.evaluation.starts import Starts, holm, paired
from hno.report.records import Row, Run
from hno.report.variants import chosen, matters, variants

LEVEL = 0.05
"""Of the test that tells two recipes apart."""
Names = tuple[str, str, str, str]
"""Game, operator, function and activation."""
Comparable = tuple[str, str, frozenset[tuple[float, ...]]]
"""What recipes share whose numbers may be compared: game, changed constants and conditions of play, and types."""


class Spread(NamedTuple):
    """A number over seeds."""

    mean: float
    interval: tuple[float, float] | None
    """Student's 95 % interval of the mean; None for one seed."""
    low: float
    high: float
    seeds: int


def spread(values: Iterable[float | None]) -> Spread | None:
    """Mean, interval and range of the numbers that exist; None if there are none."""
    found = [value for value in values if value is not None]
    if not found:
        return None
    mean, count, bounds = math.fsum(found) / len(found), len(found), None
    if count > 1:
        half = float(student.ppf(0.975, count - 1)) * statistics.stdev(found) / math.sqrt(count)
        bounds = (mean - half, mean + half)
    return Spread(mean, bounds, min(found), max(found), count)


def by_type(rows: Iterable[Row]) -> list[dict[str, Any]]:
    """Rows of one or several tables as one line per type.

    Returns:
        "theta", "seen" and "extrapolated" as in `TypeRow`, and the entries of `Pooled` over seeds.
    """
    groups: dict[tuple[float, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(row["theta"], []).append(row)
    return [
        {"theta": theta, **{flag: any(row[flag] for row in same) for flag in ("seen", "extrapolated")}}
        | pooled(same)._asdict()
        for theta, same in sorted(groups.items())
    ]


@dataclass(frozen=True, eq=False)
class Recipe:
    """Runs that differ in their seed only."""

    game: str
    operator: str
    function: str
    activation: str
    variant: str
    """Settings in which it differs from others of the same names; empty if there are none."""
    runs: tuple[Run, ...]
    """One finished run for every seed."""
    repeated: tuple[Run, ...]
    """Finished runs of a seed that a later run repeats; they do not count."""
    unfinished: int
    failed: int

    @property
    def name(self) -> str:
        """Operator, function, if results name it, activation and what else is special."""
        function = "" if self.function == NOT_AVAILABLE else self.function
        return " / ".join(filter(None, (self.operator, function, self.activation, self.variant)))

    @property
    def seeds(self) -> str:
        """How many seeds count, in words."""
        return counted(len(self.runs), "seed")

    @property
    def special(self) -> str:
        """Conditions of its runs."""
        return ", ".join(sorted({run.conditions for run in self.runs} - {""}))

    @property
    def conditions(self) -> str:
        """At how many types episodes were played, and what was special."""
        sizes = sorted({len(run.table) for run in self.runs})
        at = counted(sizes[0], "type") if len(sizes) == 1 else f"{' or '.join(map(str, sizes))} types"
        at = at if sizes else NOT_AVAILABLE
        return ", ".join(filter(None, (at, self.special)))

    @property
    def comparable(self) -> Comparable:
        """Equal for recipes whose numbers may be compared."""
        return self.game, self.special, frozenset(row["theta"] for run in self.runs for row in run.table)

    @functools.cached_property
    def types(self) -> list[dict[str, Any]]:
        """One line per type over all seeds, see `by_type`."""
        return by_type(row for run in self.runs for row in run.table)

    @functools.cached_property
    def by_seed(self) -> list[Pooled]:
        """One line per run, over all types."""
        return [pooled(run.table) for run in self.runs]

    @functools.cached_property
    def pooled(self) -> Pooled:
        """Counts over all types and seeds; the worst type is that of the pooled counts."""
        return pooled(self.types)

    @property
    def outcomes(self) -> list[Mapping[tuple[float, ...], Starts]]:
        """What came of single starts, by run and type."""
        return [run.outcomes for run in self.runs]

    @property
    def rates(self) -> Spread | None:
        """Collision rate over seeds."""
        return spread(one.rate for one in self.by_seed)

    @property
    def excess(self) -> Spread | None:
        """Relative excess cost over seeds."""
        return spread(one.relative_excess for one in self.by_seed)

    def seconds(self, stage: str) -> Spread | None:
        """Time that a stage took over seeds, s; "total" is the sum of all."""
        return spread(run.spent(stage) for run in self.runs)


def recipes(runs: Sequence[Run]) -> list[Recipe]:
    """Group runs whose settings are equal but for the seed."""
    groups: dict[Names, dict[tuple[tuple[str, str], ...], list[Run]]] = {}
    for run in runs:
        names = run.game, run.operator, run.function, run.activation
        groups.setdefault(names, {}).setdefault(tuple(sorted(_relevant(run).items())), []).append(run)
    return [
        _recipe(names, variant, same)
        for names, group in sorted(groups.items())
        for variant, same in zip(_named(group), group.values(), strict=True)
    ]


def _named(group: Mapping[tuple[tuple[str, str], ...], Sequence[Run]]) -> list[str]:
    """What tells recipes of the same names apart: what was swept, if runs say it."""
    return variants([chosen(same[0].overrides) for same in group.values()], [dict(key) for key in group])


def _relevant(run: Run) -> dict[str, str]:
    """The settings that make a recipe; without a configuration, what the results say."""
    some = {key: text for key, text in run.settings.items() if matters(key)}
    return some or {"steps": str(run.steps or NOT_AVAILABLE), "conditions": run.conditions}


def _recipe(names: Names, variant: str, runs: Sequence[Run]) -> Recipe:
    finished = [run for run in runs if run.finished]
    counted = tuple({(run.seed, run.test_seed): run for run in finished}.values())
    repeated = tuple(run for run in finished if all(run is not other for other in counted))
    failed, pruned = (sum(run.status == status for run in runs) for status in ("failed", "pruned"))
    return Recipe(*names, variant, counted, repeated, len(runs) - len(finished) - failed - pruned, failed)


def best(found: Iterable[Recipe]) -> list[Recipe]:
    """By game: the recipe with the lowest collision rate, then the lowest excess cost, of all that may be compared."""
    chosen: dict[Comparable, Recipe] = {}
    for recipe in sorted((one for one in found if one.pooled.safe_starts), key=_order):
        chosen.setdefault(recipe.comparable, recipe)
    return sorted(chosen.values(), key=lambda recipe: recipe.game)


def _order(recipe: Recipe) -> tuple[float, float]:
    return recipe.pooled.rate or 0.0, math.inf if recipe.excess is None else recipe.excess.mean


def headline(found: Iterable[Recipe]) -> Recipe | None:
    """Of the best recipes of a game the one at its usual constants and conditions, then at the most types."""
    return min(found, key=lambda one: (bool(one.special), -len(one.comparable[2]), *_order(one)), default=None)


class Rival(NamedTuple):
    """Another recipe that may be compared with a chosen one."""

    recipe: Recipe
    p_value: float | None
    """Of the paired test, see `hno.evaluation.starts.paired`, adjusted by Holm; None where starts were not kept."""
    told_apart: bool
    """Whether it is below 0.05; without it, whether the intervals of both rates have nothing in common."""


def rivals(chosen: Recipe, found: Iterable[Recipe]) -> list[Rival]:
    """All others that may be compared with a recipe, and whether the episodes tell them apart from it."""
    others = [other for other in found if other is not chosen and other.comparable == chosen.comparable]
    others = [other for other in others if chosen.pooled.interval and other.pooled.interval]
    tests = [paired(chosen.outcomes, other.outcomes) for other in others]
    adjusted = iter(holm([test.p_value for test in tests if test]))
    p_values = [next(adjusted) if test else None for test in tests]
    return [
        Rival(other, p, _apart(chosen, other) if p is None else p < LEVEL)
        for other, p in zip(others, p_values, strict=True)
    ]


def _apart(one: Recipe, other: Recipe) -> bool:
    (low, high), (least, most) = one.pooled.interval or (0, 1), other.pooled.interval or (0, 1)
    return high < least or most < low
