"""How near episodes come to a collision, from what was kept of single starts."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from hno.evaluation.format import number, percent
from hno.report.recipes import Recipe
from hno.report.records import Run
from hno.report.tables import Row, names_of

Array = NDArray[np.float64]
POINTS = 61
"""Of a curve."""


def smallest(runs: Sequence[Run]) -> tuple[Array, Array]:
    """The smallest clearance of every episode from a start that counts, and that of its equilibrium, (N,) each.

    NaN is an episode that is lost. Runs that did not keep them add nothing.
    """
    found = [
        pair
        for run in runs
        for one in run.outcomes.values()
        for digit, *pair in zip(one.counted, one.clearance, one.label_clearance, strict=False)
        if digit == "1"
    ]
    played, label = np.array(found, dtype=np.float64).reshape(-1, 2).T
    return played, label


def closer(clearances: Array, d: float) -> float:
    """The share that keeps no more than d: at 0 those that collide."""
    return float((~(clearances > d)).mean())


def said(runs: Sequence[Run]) -> list[str]:
    """A sentence: the collision rate from the quarter of starts whose equilibrium comes closest, and the widest."""
    played, label = smallest(runs)
    if len(played) < 8:
        return []
    low, high = np.quantile(label, [0.25, 0.75])
    unit = runs[0].constraint_unit
    parts = [(played[label <= low], f"up to {number(low)}"), (played[label >= high], f"{number(high)} or more")]
    rates = [f"{percent(closer(some, 0))} of {len(some):,} where it is {text} {unit}".rstrip() for some, text in parts]
    return [f"By the clearance of the equilibrium: {', '.join(rates)}."]


def curves(found: Sequence[Recipe]) -> list[Row]:
    """For every recipe the share of its safe starts that keep no more than d, and the equilibria's; safest first."""
    ordered = sorted(found, key=lambda one: (one.game, one.pooled.rate or 0.0))
    rows = list[Row]()
    for _, same in groupby(ordered, key=lambda one: one.game):
        kept = [(one, *smallest(one.runs)) for one in same]
        kept = [entry for entry in kept if len(entry[1])]
        if not kept:
            continue
        high = max(float(np.quantile(label, 0.9)) for _, _, label in kept)
        low = max(min(float(np.nanmin(played)) for _, played, _ in kept), -high)
        d = np.unique([0.0, *np.linspace(low, high, POINTS).round(4)])
        for recipe, played, label in kept:
            shares = {"share": played, "label": label}
            entries = {name: [round(closer(one, at), 6) for at in d] for name, one in shares.items()}
            unit = recipe.runs[0].constraint_unit
            rows.append({**names_of(recipe), "recipe": recipe.name, "unit": unit, "d": d.tolist(), **entries})
    return rows
