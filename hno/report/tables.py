"""The tables of a report: plain rows, for the page and for Markdown."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from hno.report.aggregate import Recipe, Spread, best, excess, seconds, total, worst
from hno.report.parsing import number as sound
from hno.report.parsing import whole
from hno.report.runs import ENDED, NOT_AVAILABLE, Run, label_statistics
from hno.report.words import interval, number, over_seeds, percent, signed, theta, worst_type

LONGEST = 400
"""Characters of a cell that are kept."""
LISTED = 6
"""Numbers of a list that are shown."""
ROWS = 200
"""Rows of any list that are kept."""


class Cell(NamedTuple):
    """A text, and what it is sorted by."""

    text: str
    order: float | str | None = None


class Row(NamedTuple):
    """Cells with what the row is filtered by."""

    cells: list[Cell]
    names: Mapping[str, str] = {}
    mark: str = ""
    """ "best", "failed" or "unfinished"; empty for any other row."""


class Table(NamedTuple):
    """Columns and rows."""

    columns: list[str]
    rows: list[Row]
    total: int | None = None
    """Rows that there are, where some may have been left out."""

    def first(self, count: int) -> Table:
        """The first rows."""
        return self._replace(rows=self.rows[:count], total=self.total or len(self.rows))


def names_of(entry: Run | Recipe, level: str) -> dict[str, str]:
    """What an element of the page is filtered by."""
    seed = {"seed": NOT_AVAILABLE if entry.seed is None else str(entry.seed)} if isinstance(entry, Run) else {}
    return {"level": level, "game": entry.game, "operator": entry.operator, "activation": entry.activation, **seed}


RECIPE_COLUMNS = [
    "game", "recipe", "seeds", "safe starts", "collisions", "rate", "95 % interval", "range over seeds", "worst type",
    "excess cost", "labels s", "training s", "total s", "open", "failed",
]  # fmt: skip


def recipe_table(found: Sequence[Recipe]) -> Table:
    """Every recipe over its seeds; the best of each game is marked."""
    chosen = {id(recipe) for recipe in best(found).values()}
    rows = [Row(_recipe(one), names_of(one, "any"), "best" if id(one) in chosen else "") for one in found]
    return Table(RECIPE_COLUMNS, rows)


def _recipe(recipe: Recipe) -> list[Cell]:
    counts, rates, most = recipe.rate, recipe.rates, worst(recipe.table)
    across = NOT_AVAILABLE if rates is None else f"{percent(rates.low)} to {percent(rates.high)}"
    return [
        Cell(recipe.game), Cell(recipe.name), Cell(str(len(recipe.runs)), len(recipe.runs)),
        Cell(f"{counts.starts:,}", counts.starts), Cell(f"{counts.collisions:,}", counts.collisions),
        Cell(percent(counts.value), counts.value),
        Cell(interval(counts.interval), (counts.interval or (None, None))[1]),
        Cell(across, None if rates is None else rates.high),
        Cell(worst_type(most), None if most is None else most.collisions / most.starts),
        Cell(over_seeds(recipe.excess), None if recipe.excess is None else recipe.excess.mean),
        _cached(recipe.seconds("labels")), *(_seconds(recipe.seconds(part)) for part in ("training", "total")),
        Cell(str(recipe.unfinished), recipe.unfinished), Cell(str(recipe.failed), recipe.failed),
    ]  # fmt: skip


def _seconds(found: Spread | None) -> Cell:
    return Cell(NOT_AVAILABLE) if found is None else Cell(number(found.mean, 0), found.mean)


CACHED = "Labels that were cached took no time, and the total is then without them."


def _cached(found: Spread | None) -> Cell:
    """Time for labels; no time is said to be the cache's."""
    if found is None or found.low > 0:
        return _seconds(found)
    return Cell("cached" if found.high == 0 else f"{number(found.mean, 0)} (partly cached)", found.mean)


RUN_COLUMNS = [
    "run", "status", "game", "operator", "activation", "seed", "steps", "safe starts", "collisions", "rate",
    "95 % interval", "worst type", "excess cost", "value error", "costate error", "total s",
]  # fmt: skip


def run_table(runs: Sequence[Run]) -> Table:
    """Every single run."""
    return Table(RUN_COLUMNS, [Row(_run(run), names_of(run, "any"), _mark(run)) for run in runs])


def _mark(run: Run) -> str:
    return "" if run.finished else (run.status if run.status in ENDED else "unfinished")


def _run(run: Run) -> list[Cell]:
    counts, most, above, steps = total(run.table), worst(run.table), excess(run.table), whole(run.content.get("steps"))
    metrics = run.content.get("metrics")
    errors = [
        sound(metrics.get(f"val/{name}_error")) if isinstance(metrics, dict) else None for name in ("value", "costate")
    ]
    spent = seconds(run, "total")
    played = bool(counts.starts)
    return [
        Cell(run.name), Cell(run.status), Cell(run.game), Cell(run.operator), Cell(run.activation),
        Cell(NOT_AVAILABLE if run.seed is None else str(run.seed), run.seed),
        Cell(NOT_AVAILABLE if steps is None else f"{steps:,}", steps),
        Cell(f"{counts.starts:,}", counts.starts),
        Cell(f"{counts.collisions:,}" if played else NOT_AVAILABLE, counts.collisions if played else None),
        Cell(percent(counts.value), counts.value),
        Cell(interval(counts.interval), (counts.interval or (None, None))[1]),
        Cell(worst_type(most), None if most is None else most.collisions / most.starts), Cell(signed(above), above),
        *(Cell(number(error, 4), error) for error in errors), Cell(number(spent, 0), spent),
    ]  # fmt: skip


def generic(entries: Sequence[Mapping[str, Any]]) -> Table:
    """Any list of mappings; columns in the order in which they turn up, those of mappings inside after their name."""
    rows = [_flat(entry) for entry in entries[:ROWS]]
    columns = list(dict.fromkeys(key for row in rows for key in row))
    return Table(
        columns,
        [Row([value_cell(row[key], key) if key in row else Cell("") for key in columns]) for row in rows],
        len(entries),
    )


def _flat(entry: Mapping[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in entry.items():
        name = str(key).replace("_", " ")
        found |= (
            {f"{name} {inner}": rest for inner, rest in _flat(value).items()}
            if isinstance(value, dict)
            else {name: value}
        )
    return found


def value_cell(value: Any, column: str = "") -> Cell:
    """Any JSON value; rates and their intervals as percentages, long lists by their length."""
    found, last = sound(value), column.split(" ")[-1]
    if value is None:
        return Cell(NOT_AVAILABLE)
    if found is not None:
        text = f"{value:,}" if isinstance(value, int) else f"{found:.4g}"
        return Cell(percent(found) if last == "rate" and 0 <= found <= 1 else text, found)
    if isinstance(value, list):
        numbers = [entry for entry in map(sound, value) if entry is not None]
        if len(numbers) != len(value) or len(numbers) > LISTED:
            return Cell(f"{len(value)} entries")
        return Cell(interval((numbers[0], numbers[1])) if last == "interval" and len(numbers) == 2 else theta(numbers))
    text = value if isinstance(value, str) else json.dumps(value, sort_keys=True)
    return Cell(text if len(text) <= LONGEST else f"{text[:LONGEST]}…")


def label_tables(runs: Sequence[Run]) -> list[tuple[str, int, Table]]:
    """Statistics of training labels: game, how many runs share them, and the table."""
    shared: dict[str, list[Run]] = {}
    for run in runs:
        if label_statistics(run):
            shared.setdefault(json.dumps([run.game, label_statistics(run)], sort_keys=True), []).append(run)
    return [
        (same[0].game, len(same), generic([_labels(e) for e in label_statistics(same[0])])) for same in shared.values()
    ]


def _labels(entry: Mapping[str, Any]) -> dict[str, Any]:
    status = entry.get("status")
    counts = {name: count for name, count in status.items() if count != 0} if isinstance(status, dict) else {}
    rest = {key: value for key, value in entry.items() if key != "status"}
    return {"theta": rest.pop("theta", None), "starts": rest.pop("starts", None), **counts, **rest}
