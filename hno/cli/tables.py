"""The tables that commands print, one function for each."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from hno.report.words import interval, number, percent

Row = Mapping[str, Any]


def types(theta: Iterable[float]) -> str:
    """Player types for people."""
    return ", ".join(f"{t:g}" for t in theta)


def show_residuals(rows: Sequence[Row], console: Console) -> None:
    """Print the HJI residual by region, over seen and over unseen types."""
    edges = rows[0]["tau"]
    parts = [f"{low:g} to {high:g} s" for low, high in itertools.pairwise(edges)]
    table = Table(
        "region", "types", "points", "mean, 1/s", "scaled", *parts, title="HJI residual",
        caption="scaled: relative to values per horizon plus the local penalty, as in the loss; "
        "last columns: scaled, by time to go",
    )  # fmt: skip
    for region in dict.fromkeys(row["region"] for row in rows):
        for seen in (True, False):
            chosen = [row for row in rows if (row["region"], row["seen"]) == (region, seen)]
            if chosen:
                table.add_row(region, "seen" if seen else "unseen", *_residual_cells(chosen))
    console.print(table)


def _residual_cells(rows: Sequence[Row]) -> list[str]:
    sizes = [row["points"] for row in rows]
    means = [weighted([row[name] for row in rows], sizes) for name in ("physical", "scaled")]
    for part in range(len(rows[0]["tau"]) - 1):
        counts = [row["points_by_tau"][part] for row in rows]
        means.append(weighted([row["scaled_by_tau"][part] for row in rows], counts))
    return [f"{sum(sizes):,}", *("n/a" if mean is None else f"{mean:.3g}" for mean in means)]


def weighted(values: Sequence[float | None], counts: Sequence[int]) -> float | None:
    """Mean over everything that several means are over; None where there is nothing."""
    pairs = [(value, count) for value, count in zip(values, counts, strict=True) if value is not None and count]
    return sum(value * count for value, count in pairs) / sum(count for _, count in pairs) if pairs else None


def show_robustness(rows: Sequence[Row], console: Console) -> None:
    """Print collisions under every condition."""
    columns = ("condition", "safe starts", "collisions", "rate", "95 % interval", "worst type", "excess cost")
    table = Table(*columns, title="Robustness", caption="excess cost: above the undisturbed equilibrium's joint cost")
    for row in rows:
        table.add_row(
            row["name"],
            f"{row['safe_starts']:,}",
            str(row["collisions"]),
            percent(row["rate"]),
            interval(row["interval"]),
            _worst(row["types"]),
            f"{number(row['median_excess_cost'])} of {number(row['median_label_cost'])}",
        )
    console.print(table)


def _worst(counts: Sequence[Row]) -> str:
    counted = [row for row in counts if row["safe_starts"]]
    if not counted:
        return "n/a"
    if not any(row["collisions"] for row in counted):
        return "none"
    worst = max(counted, key=lambda row: row["collisions"] / row["safe_starts"])
    return f"{worst['collisions']} of {worst['safe_starts']} at ({types(worst['theta'])})"


def show_comparison(content: Mapping[str, Any], console: Console) -> None:
    """Print every model against the first, on the same starts."""
    names = short_names([content["reference"], *(row["checkpoint"] for row in content["models"])])
    columns = ("model", "starts", "both", "only first", "only this", "difference of rates", "95 % interval", "p")
    table = Table(
        *columns,
        title=f"Collisions from the same starts, against {names[0]}",
        caption="interval: Tango's score interval of the paired difference; p: exact McNemar test of equal rates",
    )
    for name, row in zip(names[1:], content["models"], strict=True):
        counts = (f"{row[key]:,}" for key in ("starts", "both", "only_reference", "only_other"))
        p_value = "n/a" if row["p_value"] is None else f"{row['p_value']:.2g}"
        table.add_row(name, *counts, percent(row["difference"]), interval(row["interval"]), p_value)
    console.print(table)


def short_names(paths: Sequence[str]) -> list[str]:
    """Paths without the folders that all have in common."""
    whole = [Path(path).resolve() for path in paths]
    common = os.path.commonpath([path.parent for path in whole])
    return [str(path.relative_to(common)) for path in whole]
