"""The tables of a report: columns of `hno.evaluation.sections`, and rows with what they are filtered by."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from hno.evaluation.format import NOT_AVAILABLE, interval, number, percent, signed, types, whole
from hno.evaluation.outcome import Pooled
from hno.evaluation.sections import Column, plain, sections
from hno.report.recipes import Recipe, Spread, TypeCounts, best, pool, seconds
from hno.report.records import Run
from hno.report.verdicts import at, over_seeds


class Row(NamedTuple):
    """Values by the names of columns."""

    values: Mapping[str, Any]
    names: Mapping[str, str] = {}
    """What the row is filtered by."""
    mark: str = ""
    """ "best", "failed" or "unfinished"; empty for any other row."""


class Table(NamedTuple):
    """Columns and rows."""

    columns: Sequence[Column]
    rows: Sequence[Row]

    def cells(self, row: Row) -> list[tuple[str, float | None]]:
        """Texts of a row, each with the number that it is sorted by."""
        values = [(column, row.values.get(column.name)) for column in self.columns]
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


def names_of(entry: Run | Recipe, level: str) -> dict[str, str]:
    """What an element of the page is filtered by; its level is "recipe", "run" or "any"."""
    seed = {"seed": plain(entry.seed)} if isinstance(entry, Run) else {}
    return {"level": level, "game": entry.game, "operator": entry.operator, "activation": entry.activation, **seed}


def _worst(found: tuple[Any, float] | None) -> str:
    """The type with the highest rate: "none" where nothing collided."""
    if found is None:
        return NOT_AVAILABLE
    return "none" if found[0] is None else f"{at(found[0])} {percent(found[1])}"


def _rounded(value: float | Spread | None) -> str:
    return number(value.mean if isinstance(value, Spread) else value, 0)


def _labels(found: Spread | None) -> str:
    """Time for labels; no time is said to be the cache's."""
    if found is None or found.low > 0:
        return _rounded(found)
    return "cached" if found.high == 0 else f"{_rounded(found)} (partly cached)"


def _range(found: Spread | None) -> str:
    return NOT_AVAILABLE if found is None else f"{percent(found.low)} to {percent(found.high)}"


CACHED = "Labels that were cached took no time, and the total is then without them."
COUNTS = (
    Column("safe_starts", "safe starts", format=whole),
    Column("collisions", "collisions", format=whole),
    Column("rate", "rate", format=percent),
    Column("interval", "95 % interval", format=interval),
)
RECIPE = (
    Column("game", "game"), Column("name", "recipe"), Column("seeds", "seeds", format=whole), *COUNTS,
    Column("rates", "range over seeds", format=_range), Column("worst", "worst type", format=_worst),
    Column("excess", "excess cost", format=over_seeds), Column("labels", "labels", "s", _labels),
    Column("training", "training", "s", _rounded), Column("total", "total", "s", _rounded),
    Column("unfinished", "open", format=whole), Column("failed", "failed", format=whole),
)  # fmt: skip
COST = tuple(one for one in RECIPE if one.name in ("game", "name", "seeds", "labels", "training", "total"))
"""Seconds of every stage (the paper's cost table)."""
RUN = (
    Column("name", "run"), Column("status", "status"), Column("game", "game"), Column("operator", "operator"),
    Column("activation", "activation"), Column("seed", "seed"), Column("steps", "steps", format=whole), *COUNTS,
    Column("worst", "worst type", format=_worst), Column("excess", "excess cost", format=signed),
    Column("value_error", "value error", format=lambda value: number(value, 4)),
    Column("costate_error", "costate error", format=lambda value: number(value, 4)),
    Column("total", "total", "s", _rounded),
)  # fmt: skip
TYPE = (
    Column("theta", "θ", format=lambda found: found if isinstance(found, str) else at(found)),
    Column("counts", "collide"),
    Column("rate", "rate", format=percent),
    Column("interval", "95 %", format=interval),
)


def _counts(found: Pooled) -> dict[str, Any]:
    worst = None if found.worst_rate is None else (found.worst_theta, found.worst_rate)
    return {**found._asdict(), "worst": worst, "collisions": found.collisions if found.safe_starts else None}


def recipe_table(found: Sequence[Recipe]) -> Table:
    """Every recipe over its seeds; the best of each game is marked."""
    chosen = best(found).values()
    rows = []
    for one in found:
        spent = {stage: one.seconds(stage) for stage in ("labels", "training", "total")}
        counts = {"seeds": len(one.runs), "unfinished": one.unfinished, "failed": one.failed}
        values = {**_counts(one.pooled), **counts, **spent, "rates": one.rates, "excess": one.excess}
        mark = "best" if any(one is other for other in chosen) else ""
        rows.append(Row({**values, "game": one.game, "name": one.name}, names_of(one, "any"), mark))
    return Table(RECIPE, rows)


def run_table(runs: Sequence[Run]) -> Table:
    """Every single run."""
    return Table(RUN, [Row(_run(run), names_of(run, "any"), _mark(run)) for run in runs])


def _mark(run: Run) -> str:
    return "" if run.finished else ("failed" if run.status == "failed" else "unfinished")


def _run(run: Run) -> dict[str, Any]:
    whole_table = pool(run.table)
    errors = {f"{name}_error": run.metrics.get(f"val/{name}_error") for name in ("value", "costate")}
    known = {name: getattr(run, name) for name in ("name", "status", "game", "operator", "activation", "seed", "steps")}
    return {**_counts(whole_table), **errors, **known, "excess": whole_table.relative_excess,
            "total": seconds(run, "total")}  # fmt: skip


def type_table(found: Iterable[TypeCounts]) -> Table:
    """Numbers of a heat map."""
    rows = []
    for one in found:
        remarks = [word for word, flag in (("seen", one.seen), ("extrapolated", one.extrapolated)) if flag]
        theta = " ".join([at(one.theta), *remarks])
        rows.append(Row({**one._asdict(), "theta": theta, "counts": f"{one.collisions:,} of {one.safe_starts:,}"}))
    return Table(TYPE, rows)


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
                table = Table(section.columns, [Row(row) for row in section.rows(content)])
                found.append(SectionTable(section.heading, section.note, table, section.remarks(content, entries)))
                found[-1].table.texts  # noqa: B018  # formats fail on foreign values
            except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
                said = f"cannot be shown: its entry in results.json is damaged ({type(error).__name__}: {error})"
                found.append(SectionTable(section.heading, "", Table((), ()), [said]))
    return found


def mapping_table(entries: Sequence[Mapping[str, Any]]) -> Table:
    """Any list of mappings; columns in the order in which they turn up."""
    keys = dict.fromkeys(key for entry in entries for key in entry)
    columns = [Column(key, key.replace("_", " "), format=_text) for key in keys]
    return Table(columns, [Row(entry) for entry in entries])


def _text(value: Any) -> str:
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"
    if isinstance(value, list) and all(isinstance(entry, (int, float)) for entry in value):
        return f"({types(value)})"
    return plain(value) if value is None or isinstance(value, str) else json.dumps(value, sort_keys=True)


def label_tables(runs: Sequence[Run]) -> list[tuple[str, int, Table]]:
    """Statistics of training labels: game, how many runs share them, and the table."""
    shared: dict[str, list[Run]] = {}
    for run in runs:
        if run.label_statistics:
            shared.setdefault(json.dumps([run.game, run.label_statistics], sort_keys=True), []).append(run)
    return [
        (same[0].game, len(same), mapping_table([_label_row(entry) for entry in same[0].label_statistics]))
        for same in shared.values()
    ]


def _label_row(entry: Mapping[str, Any]) -> dict[str, Any]:
    """An entry with its counts by status, as far as they are not 0, as columns of their own."""
    status = entry.get("status")
    counts = {name: count for name, count in status.items() if count} if isinstance(status, dict) else {}
    rest = {key: value for key, value in entry.items() if key != "status"}
    return {"theta": rest.pop("theta", None), "starts": rest.pop("starts", None), **counts, **rest}
