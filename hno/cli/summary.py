"""What a run prints at its end."""

from __future__ import annotations

import logging
import sys
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lightning.fabric.utilities.exceptions import MisconfigurationException
from rich.console import Console
from rich.table import Table

import hno
from hno.cli.sections import SECTIONS
from hno.cli.tables import short_names, show_comparison, types
from hno.registry import UnknownNameError
from hno.report.totals import totals
from hno.report.words import interval, number, percent

log = logging.getLogger(__name__)

COLUMNS = (
    "theta", "labels", "safe", "collisions", "rate", "95 % interval", "distance", "excess cost", "saturated", "errors",
    "apart",
)  # fmt: skip
WIDTH = 140
"""Columns of text where there is no terminal to ask."""


def show(results: Mapping[str, Any], folder: Path) -> None:
    """Print the tables and the sections of every model, the totals and where everything lies."""
    console = Console(width=None if sys.stdout.isatty() else WIDTH)
    models = results.get("models", [results])
    names = short_names([str(model["checkpoint"]) for model in models]) if len(models) > 1 else [""]
    for name, model in zip(names, models, strict=True):
        _show_model(model, results["clearance"], name, console)
    if "comparison" in results:
        show_comparison(results["comparison"], console)
    spent = ", ".join(f"{part.replace('_', ' ')} {seconds:.0f} s" for part, seconds in results["seconds"].items())
    console.print(f"Time: {spent}\nResults: {folder / 'results.json'}", soft_wrap=True)


def _show_model(model: Mapping[str, Any], clearance: float, name: str, console: Console) -> None:
    parts = [str(model[key]) for key in ("game", "operator", "activation")]
    table = Table(*COLUMNS, title=" / ".join([*parts, name] if name else parts), caption=_caption(clearance))
    for row in model["table"]:
        table.add_row(*_cells(row))
    console.print(table)
    console.print(verdict(model["table"]), *remarks(model["table"], clearance), sep="\n")
    for key, section in SECTIONS.items():
        if key in model:
            section.show(model[key], console)


def _caption(clearance: float) -> str:
    return (
        f"safe: starts whose equilibrium keeps {100 * clearance:g} cm; distance: smallest, 5 % quantile and median, in "
        "m; excess cost: above the equilibrium's joint cost, median; saturated: controls on a bound; errors: of values "
        "and costates along labels; apart: unsolved / inevitable / marginal starts"
    )


def _cells(row: Mapping[str, Any]) -> list[str]:
    quantiles = row["distance_quantiles"]
    return [
        types(row["theta"]),
        "seen" if row["seen"] else "unseen",
        f"{row['safe_starts']} of {row['starts']}",
        str(row["collisions"]),
        percent(row["rate"]),
        interval(row["interval"]),
        "n/a" if quantiles is None else f"{quantiles[0]:.2f}, {quantiles[-1]:.2f}",
        f"{number(row['median_excess_cost'])} of {number(row['median_label_cost'])}",
        percent(row["saturated"], 1),
        ", ".join(percent(row[name], 1) for name in ("value_error", "costate_error")),
        f"{row['unsolved']} / {row['inevitable']} / {row['marginal']}",
    ]


def remarks(table: Sequence[Mapping[str, Any]], clearance: float) -> list[str]:
    """Which types have no rate and why, and which lie outside the game's range or that of training."""
    said = [
        f"No rate (n/a) at ({types(row['theta'])}): of {row['starts']} starts none has an equilibrium that keeps "
        f"{100 * clearance:g} cm; {row['unsolved']} unsolved, {row['inevitable']} inevitable, {row['marginal']} "
        "marginal."
        for row in table
        if row["rate"] is None
    ]
    outside = [f"({types(row['theta'])})" for row in table if row["extrapolated"]]
    if outside:
        said.append(f"Outside the types that the game is made for, results extrapolate: {', '.join(outside)}.")
    beyond = [f"({types(row['theta'])})" for row in table if row["outside_seen"]]
    if beyond:
        said.append(
            f"{len(beyond)} of {len(table)} types lie outside the box around the trained ones: {', '.join(beyond)}."
        )
    return said


def verdict(table: Sequence[Mapping[str, Any]]) -> str:
    """The totals over all types in one sentence."""
    whole = totals(table)
    if whole.rate is None:
        return "No start has a safe equilibrium: there is no collision rate (n/a)."
    total = f"{whole.collisions} collisions in {whole.safe_starts} safe starts ({percent(whole.rate)})"
    if whole.worst_theta is None:
        return f"{total}."
    return f"{total}; worst {percent(whole.worst_rate)} at ({types(whole.worst_theta)})."


def report(error: Exception) -> None:
    """Log what went wrong: one message for errors that were raised on purpose, a traceback for surprises."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = bool(frames) and Path(frames[-1].filename).is_relative_to(Path(hno.__file__).parent)
    meant = ours and isinstance(error, (ValueError, RuntimeError, UnknownNameError))
    expected = meant or isinstance(error, (OSError, MisconfigurationException))
    log.error("%s", error, exc_info=None if expected else error)
