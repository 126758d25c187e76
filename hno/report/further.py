"""Tables of the further results of evaluate.py, folded and cut to the room that a page has for them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from markupsafe import escape

from hno.report.parsing import number, records, whole
from hno.report.runs import Run
from hno.report.tables import Table, generic, names_of

SECTIONS = {
    "robustness": "Robustness",
    "residuals": "HJI residual by region",
    "ntk": "Neural tangent kernel",
    "online": "Online solver as a yardstick",
    "comparison": "Models side by side",
}
"""Headings of sections of results.json."""
CELL = 40
"""Bytes of markup around a cell, about."""


class Further(NamedTuple):
    """The sections of one run."""

    run: str
    names: Mapping[str, str]
    """What they are filtered by."""
    tables: Mapping[str, Table]
    """By heading."""


def further(runs: Sequence[Run]) -> list[Further]:
    """The sections of all runs that have any."""
    found = [Further(run.name, names_of(run, "any"), sections(run)) for run in runs]
    return [one for one in found if one.tables]


def sections(run: Run) -> dict[str, Table]:
    """Tables of the further results of a run, by heading."""
    found: dict[str, Table] = {}
    for key, heading in SECTIONS.items():
        content = run.content.get(key)
        if isinstance(content, dict) and content:
            lists = {name: entry for name, entry in content.items() if records(entry)}
            rest = {name: entry for name, entry in content.items() if name not in lists}
            found |= {heading: generic([rest])} if rest else {}
            found |= {f"{heading}: {name}": generic(records(entry)) for name, entry in lists.items()}
        elif records(content):
            found[heading] = generic(folded(records(content)) if key == "residuals" else records(content))
    return found


def folded(rows: Sequence[Mapping[str, Any]]) -> Sequence[Mapping[str, Any]]:
    """Residuals by region, over seen and over unseen types, weighted by points; rows of another form as they are."""
    if not all({"region", "seen", "points", "physical", "scaled"} <= set(row) for row in rows):
        return rows
    groups: dict[tuple[str, bool], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault((str(row["region"]), row["seen"] is True), []).append(row)
    return [
        {
            "region": region, "types": f"{len(same)} {'seen' if seen else 'unseen'}",
            "points": sum(whole(row["points"]) or 0 for row in same),
            "physical": _weighted(same, "physical"), "scaled": _weighted(same, "scaled"),
        }
        for (region, seen), same in groups.items()
    ]  # fmt: skip


def _weighted(rows: Sequence[Mapping[str, Any]], name: str) -> float | None:
    """Mean over all points; None where there is none."""
    pairs = [(value, whole(row["points"]) or 0) for row in rows if (value := number(row[name])) is not None]
    points = sum(count for _, count in pairs)
    return sum(value * count for value, count in pairs) / points if points else None


def fitting(entries: Sequence[Further], budget: int) -> list[Further]:
    """The first ones whose tables fit into a number of bytes, the last of them with the rows that fit."""
    kept: list[Further] = []
    for entry in entries:
        tables: dict[str, Table] = {}
        for heading, table in entry.tables.items():
            budget -= sum(_bytes(column) for column in (heading, heading, entry.run, *table.columns))
            count = 0
            for row in table.rows:
                budget -= sum(_bytes(cell.text, cell.order) for cell in row.cells) + CELL
                if budget < 0:
                    break
                count += 1
            tables[heading] = table.first(count)
        kept += [entry._replace(tables=tables)] if any(table.rows for table in tables.values()) else []
        if budget < 0:
            break
    return kept


def _bytes(*texts: object) -> int:
    return CELL + sum(len(escape(str(text)).encode()) for text in texts)
