"""The tables of a report, with columns as those of `hno.evaluation.sections`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from hno.evaluation.format import NAMES, NOT_AVAILABLE, at, number, percent, signed, whole
from hno.evaluation.outcome import Pooled, pooled
from hno.evaluation.sections import COUNTS, Column, plain, sections
from hno.report.recipes import Recipe, Spread, best
from hno.report.records import Run
from hno.report.verdicts import over_seeds

Row = Mapping[str, Any]
"""Values by the names of columns; the page also uses "game" and what else it filters by, and "mark"."""


class Table(NamedTuple):
    """Columns and rows."""

    columns: Sequence[Column]
    rows: Sequence[Row]

    def cells(self, row: Row) -> list[tuple[str, float | None]]:
        """Texts of a row, each with the number that it is sorted by."""
        values = [(column, row.get(column.name)) for column in self.columns]
        return [(column.format(value), _order(value)) for column, value in values]

    @property
    def texts(self) -> list[list[str]]:
        """Texts of all rows."""
        return [[text for text, _ in self.cells(row)] for row in self.rows]


def _order(value: Any) -> float | None:
    """A number as it is, of bounds the upper one, of a spread the mean."""
    if isinstance(value, Spread):
        return value.mean
    if isinstance(value, tuple) and value and not isinstance(value[-1], str):
        value = value[-1]
    return value if isinstance(value, (int, float)) and not isinstance(value, bool) else None


def _worst(found: tuple[Any, float | None]) -> str:
    """The type with the highest rate: "none" where nothing collided."""
    theta, rate = found
    return f"{at(theta)} {percent(rate)}" if theta else (NOT_AVAILABLE if rate is None else "none")


def _rounded(value: float | Spread | None) -> str:
    return number(value.mean if isinstance(value, Spread) else value, 0)


def _labels(found: Spread | None) -> str:
    """Time for labels; no time is said to be the cache's."""
    if found is None or found.low > 0:
        return _rounded(found)
    return "cached" if found.high == 0 else f"{_rounded(found)} (partly cached)"


def _range(found: Spread | None) -> str:
    if found is None or found.seeds == 1:
        return NOT_AVAILABLE
    return f"{percent(found.low)} to {percent(found.high)}"


FILTERS = (*NAMES, "seed")
"""What the page is filtered by."""
CACHED = "Labels that were cached took no time, and the total is then without them."
RECIPE = (
    Column("game", "game"), Column("name", "recipe"), Column("seeds", "seeds", format=whole), *COUNTS,
    Column("rates", "range over seeds", format=_range), Column("worst", "worst type", format=_worst),
    Column("excess", "excess cost", format=over_seeds), Column("labels", "labels", "s", _labels),
    Column("training", "training", "s", _rounded), Column("total", "total", "s", _rounded),
    Column("unfinished", "open", format=whole), Column("failed", "failed", format=whole),
)  # fmt: skip
RUN = (
    Column("name", "run"), Column("status", "status"), Column("game", "game"), Column("operator", "operator"),
    Column("function", "function"), Column("activation", "activation"), Column("seed", "seed"),
    Column("steps", "steps", format=whole), *COUNTS,
    Column("worst", "worst type", format=_worst), Column("relative_excess", "excess cost", format=signed),
    Column("value_error", "value error", format=lambda value: number(value, 4)),
    Column("costate_error", "costate error", format=lambda value: number(value, 4)),
    Column("total", "total", "s", _rounded),
)  # fmt: skip
TYPE = (Column("theta", "θ", format=at), Column("labels", "labels"), *COUNTS)


def _counts(found: Pooled) -> dict[str, Any]:
    some = {"worst": (found.worst_theta, found.worst_rate)} | ({} if found.safe_starts else {"collisions": None})
    return found._asdict() | some


def names_of(entry: Run | Recipe) -> dict[str, Any]:
    """What an entry of the page is filtered by."""
    return {key: plain(getattr(entry, key)) for key in FILTERS if hasattr(entry, key)}


def recipe_table(found: Sequence[Recipe]) -> Table:
    """Every recipe over its seeds; the best of each game is marked."""
    chosen, rows = best(found), list[Row]()
    for one in found:
        known = {name: getattr(one, name) for name in ("name", "unfinished", "failed", "rates", "excess")}
        known |= {stage: one.seconds(stage) for stage in ("labels", "training", "total")}
        known |= {"seeds": len(one.runs), "mark": "best" if one in chosen else ""}
        rows.append({**names_of(one), **_counts(one.pooled), **known})
    return Table(RECIPE, rows)


def run_table(runs: Sequence[Run]) -> Table:
    """Every single run."""
    rows = list[Row]()
    for run in runs:
        known = {name: getattr(run, name) for name in ("name", "status", "steps")} | {"total": run.spent("total")}
        errors = {f"{name}_error": run.metrics.get(f"val/{name}_error") for name in ("value", "costate")}
        mark = "" if run.finished else ("failed" if run.status == "failed" else "unfinished")
        rows.append({**names_of(run), **_counts(pooled(run.table)), **known, **errors, "mark": mark})
    return Table(RUN, rows)


def type_table(found: Sequence[Row]) -> Table:
    """Numbers of a heat map, from rows of `recipes.by_type`."""
    words = {True: "seen", False: "unseen"}
    return Table(
        TYPE, [{**one, "labels": words[one["seen"]] + ", extrapolated" * one["extrapolated"]} for one in found]
    )


class SectionTable(NamedTuple):
    """A section of an evaluation."""

    heading: str
    note: str
    table: Table
    remarks: list[str]


def section_tables(run: Run) -> list[SectionTable]:
    """The sections of a run beside its collision table, with the columns that the terminal shows."""
    found, entries = [], {**run.entries, "clearance": run.clearance, "constraint_unit": run.constraint_unit}
    for name in sections.names():
        content = run.entries.get(name)
        if content:
            section = sections.get(name)()
            try:
                table = Table(section.columns, section.rows(content))
                table.texts  # noqa: B018  # formats fail on foreign values
                found.append(SectionTable(section.heading, section.note, table, section.remarks(content, entries)))
            except (LookupError, TypeError, ValueError, AttributeError) as error:
                said = f"cannot be shown: its entry in results.json is damaged ({type(error).__name__}: {error})"
                found.append(SectionTable(section.heading, "", Table((), ()), [said]))
    return found


def mapping_table(entries: Sequence[Row]) -> Table:
    """Any list of mappings; columns in the order in which they turn up."""
    keys = dict.fromkeys(key for entry in entries for key in entry)
    return Table([Column(key, key.replace("_", " "), format=_text) for key in keys], entries)


def _text(value: Any) -> str:
    if isinstance(value, list):
        return f"({', '.join(map(_text, value))})"
    if isinstance(value, dict):
        return ", ".join(f"{count} {name}" for name, count in value.items() if count)
    return f"{value:.4g}" if isinstance(value, float) else plain(value)


def label_tables(runs: Sequence[Run]) -> list[tuple[str, int, Table]]:
    """Statistics of training labels: game, how many runs share them, and the table."""
    shared: dict[str, list[Run]] = {}
    for run in runs:
        if run.label_statistics:
            shared.setdefault(json.dumps([run.game, run.label_statistics], sort_keys=True), []).append(run)
    return [(same[0].game, len(same), mapping_table(same[0].label_statistics)) for same in shared.values()]
