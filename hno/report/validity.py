"""From where a headline's rate holds, and what is known of elsewhere."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import groupby
from typing import Any

from hno.evaluation.format import interval, percent
from hno.evaluation.metrics import clopper_pearson
from hno.report import clearances
from hno.report.records import Run


def validity(runs: Sequence[Run]) -> str:
    """Sentences about the runs of one recipe, of which there is at least one.

    Where starts come from and which of them count; the rate from wider start boxes, if an evaluation has it
    (`robustness`, conditions of a width alone), and by the clearance of the equilibrium, if it was kept; errors of the
    value by region, if one has them (`off_labels`).
    """
    first = runs[0]
    box = "the start box" if first.widen == 1 else f"a start box {first.widen:g} times as wide as the game's"
    said = [f"Valid from {box}, where an equilibrium keeps {first.clearance:g} {first.constraint_unit}".rstrip() + "."]
    for widen, pairs in groupby(sorted(_widened(runs)), key=lambda one: one[0]):
        collisions, starts = (sum(column) for column in list(zip(*pairs, strict=True))[1:])
        between = interval(clopper_pearson(collisions, starts))
        said.append(f"{widen:g} times as wide: {percent(collisions / starts)} of {starts:,} ({between}).")
    said += clearances.said(runs)
    regions = [f"{region} {percent(error, 0)}" for region, error in _errors(runs)]
    if regions:
        said.append(f"Value error relative to its size: {', '.join(regions)}.")
    return " ".join(said)


def _widened(runs: Sequence[Run]) -> Iterator[tuple[float, int, int]]:
    """Width, collisions and safe starts of every condition that differs in the width of the start box alone."""
    for run in runs:
        for row in _rows(run.entries.get("robustness")):
            with suppress(LookupError, TypeError, ValueError):  # damaged entries are named in their section
                if set(row["condition"]) == {"widen"} and row["safe_starts"] > 0:
                    yield float(row["condition"]["widen"]), int(row["collisions"]), int(row["safe_starts"])


def _errors(runs: Sequence[Run]) -> list[tuple[str, float]]:
    """Mean over runs and times to go of the relative error of the value, by region."""
    found: dict[str, list[float]] = {}
    for run in runs:
        for row in _rows(run.entries.get("off_labels")):
            with suppress(LookupError, TypeError, ValueError):
                found.setdefault(str(row["region"]), []).append(float(row["relative_value"]))
    return [(region, sum(some) / len(some)) for region, some in found.items()]


def _rows(content: Any) -> list[Any]:
    return content if isinstance(content, list) else []
