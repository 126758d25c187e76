"""What a run prints at its end."""

from __future__ import annotations

import logging
import shlex
import sys
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lightning.fabric.utilities.exceptions import MisconfigurationException
from rich.console import Console
from rich.table import Table

import hno
from hno.registry import UnknownNameError
from hno.report.totals import totals

log = logging.getLogger(__name__)

COLUMNS = ("theta", "labels", "safe", "collisions", "rate", "95 % interval", "distance", "excess cost", "apart")
WIDTH = 120
"""Columns of text where there is no terminal to ask."""


def show(results: Mapping[str, Any], folder: Path) -> None:
    """Print the collision table, the totals, where everything lies and how to see it."""
    title = " / ".join(str(results[name]) for name in ("game", "operator", "activation"))
    table = Table(*COLUMNS, title=title, caption=_caption(results))
    for row in results["table"]:
        table.add_row(*_cells(row))
    console = Console(width=None if sys.stdout.isatty() else WIDTH)
    console.print(table)
    console.print(verdict(results["table"]))
    spent = ", ".join(f"{part.replace('_', ' ')} {seconds:.0f} s" for part, seconds in results["seconds"].items())
    console.print(f"Time: {spent}\nResults: {folder / 'results.json'}\n{where(folder)}", soft_wrap=True)


def where(folder: Path) -> str:
    """How to see a run or a sweep."""
    return f"Page: python -m hno.report {shlex.quote(str(folder))}"


def _caption(results: Mapping[str, Any]) -> str:
    return (
        f"safe: starts whose equilibrium keeps {100 * results['clearance']:g} cm; distance: smallest, in m; "
        "excess cost: above the equilibrium's joint cost; both medians; apart: unsolved / inevitable / marginal starts"
    )


def _cells(row: Mapping[str, Any]) -> list[str]:
    interval = row["interval"]
    return [
        ", ".join(f"{t:g}" for t in row["theta"]),
        "seen" if row["seen"] else "unseen",
        f"{row['safe_starts']} of {row['starts']}",
        str(row["collisions"]),
        percent(row["rate"]),
        "n/a" if interval is None else f"{100 * interval[0]:.2f} to {100 * interval[1]:.2f} %",
        number(row["median_min_distance"]),
        f"{number(row['median_excess_cost'])} of {number(row['median_label_cost'])}",
        f"{row['unsolved']} / {row['inevitable']} / {row['marginal']}",
    ]


def percent(rate: float | None) -> str:
    """A rate for people; "n/a" when there was nothing to count."""
    return "n/a" if rate is None else f"{100 * rate:.2f} %"


def number(value: float | None) -> str:
    """A number for people; "n/a" when there is none."""
    return "n/a" if value is None else f"{value:.2f}"


def verdict(table: Sequence[Mapping[str, Any]]) -> str:
    """The totals over all types in one sentence."""
    whole = totals(table)
    if whole.rate is None or whole.worst_theta is None:
        return "No start has a safe equilibrium: there is no collision rate (n/a)."
    at = ", ".join(f"{t:g}" for t in whole.worst_theta)
    total = f"{whole.collisions} collisions in {whole.safe_starts} safe starts ({percent(whole.rate)})"
    return f"{total}; worst {percent(whole.worst_rate)} at ({at})."


def report(error: Exception) -> None:
    """Log what went wrong: one message for errors that were raised on purpose, a traceback for surprises."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = bool(frames) and Path(frames[-1].filename).is_relative_to(Path(hno.__file__).parent)
    meant = ours and isinstance(error, (ValueError, RuntimeError, UnknownNameError))
    expected = meant or isinstance(error, (OSError, MisconfigurationException))
    log.error("%s", error, exc_info=None if expected else error)
