"""Runs of one recipe with several seeds as one line: pooled counts, and the spread over seeds."""

from __future__ import annotations

import functools
import math
import statistics
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from scipy.stats import t as student

from hno.evaluation.metrics import clopper_pearson
from hno.report.parsing import TypeResult, number
from hno.report.runs import NOT_AVAILABLE, Run

CONFIDENCE = 0.95
"""Of every interval."""
IGNORED = ("seed", "resume", "cache", "workers", "data.cache", "data.workers", "trainer.print_every", "trainer.threads")
"""Settings that do not make another recipe."""
SHOWN = 3
"""Differing settings that are named in a recipe's label."""


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
"""Game, conditions and types."""


class Recipe(NamedTuple):
    """Runs that differ in their seed only."""

    game: str
    operator: str
    activation: str
    variant: str
    """Settings in which it differs from others of the same names; empty if there are none."""
    conditions: str
    """Changed constants of the game, how episodes were played, and at how many types."""
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
    def comparable(self) -> Comparable:
        """What recipes share whose numbers may be compared: the game with its constants, play, and the very types."""
        return self.game, self.conditions, frozenset(row.theta for run in self.runs for row in run.table)

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
    known = [(row.excess, row.label_cost) for row in rows if row.excess is not None]
    ratios = [above / abs(cost) for above, cost in known if cost]
    return statistics.median(ratios) if ratios else None


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


def recipes(runs: Sequence[Run]) -> list[Recipe]:
    """Group runs whose settings are equal but for the seed."""
    groups: dict[tuple[str, ...], dict[tuple[tuple[str, str], ...], list[Run]]] = {}
    for run in runs:
        names = (run.game, run.operator, run.activation)
        groups.setdefault(names, {}).setdefault(tuple(sorted(relevant(run).items())), []).append(run)
    return [
        _recipe(names, variant, same)
        for names, group in sorted(groups.items())
        for variant, same in zip(_variants([dict(key) for key in group]), group.values(), strict=True)
    ]


def relevant(run: Run) -> dict[str, str]:
    """The settings that make a recipe; without a configuration, what the results say."""
    chosen = {key: text for key, text in run.settings.items() if key not in IGNORED and not key.startswith("logger.")}
    return chosen or {"steps": str(run.content.get("steps", NOT_AVAILABLE)), "conditions": run.conditions}


def _variants(settings: Sequence[Mapping[str, str]]) -> list[str]:
    """What tells each of some settings from the others."""
    keys = sorted({key for one in settings for key in one})
    differing = [key for key in keys if len({one.get(key) for one in settings}) > 1]
    more = [f"{len(differing) - SHOWN} more"] if len(differing) > SHOWN else []
    return [", ".join([f"{key}={_short(one.get(key))}" for key in differing[:SHOWN]] + more) for one in settings]


def _short(text: str | None) -> str:
    """A setting for a label: of a path its last three parts, of anything else the beginning."""
    if text is None:
        return NOT_AVAILABLE
    return "/".join(text.split("/")[-3:]) if "/" in text else text[:40]


def _recipe(names: tuple[str, ...], variant: str, runs: Sequence[Run]) -> Recipe:
    last: dict[object, Run] = {}
    for run in runs:
        if run.finished:
            last[run.seed, run.content.get("test_seed")] = run
    counted = tuple(last.values())
    repeated = tuple(run for run in runs if run.finished and all(run is not other for other in counted))
    failed = sum(run.status == "failed" for run in runs)
    unfinished = len(runs) - len(counted) - len(repeated) - failed
    sizes = sorted({len(run.table) for run in counted})
    conditions = ", ".join(sorted({text for run in counted for text in (_constants(run), run.conditions)} - {""}))
    at = f"{' or '.join(map(str, sizes))} types" if sizes else NOT_AVAILABLE
    game, operator, activation = names
    return Recipe(
        game, operator, activation, variant, ", ".join(filter(None, (at, conditions))), counted, repeated, unfinished,
        failed,
    )  # fmt: skip


def _constants(run: Run) -> str:
    changed = {key: text for key, text in sorted(run.settings.items()) if key.startswith("game.constants.")}
    return ", ".join(f"{key.removeprefix('game.constants.')} {text}" for key, text in changed.items())


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
    return min(found, key=lambda one: ("," in one.conditions, -len(one.comparable[2]), *_order(one)))


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
