"""What the page's script works with, as JSON: heat maps, rates of recipes, learning curves and episodes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from hno.evaluation.format import at, interval, number, percent, signed
from hno.report.episode import Episode, closest, columns
from hno.report.recipes import Recipe
from hno.report.records import Run
from hno.report.tables import Row, names_of, type_table
from hno.report.verdicts import clearance, share

POINTS = 120
"""Points of a learning curve, at most."""
DIGITS = 5
"""Significant digits of its values."""
CELL = "theta", "seen", "safe_starts", "rate", "interval"
"""What a heat map shows of a type."""


def heat_map(types: Sequence[Row]) -> Row:
    """Cells of a heat map and the table of its numbers, from rows of `recipes.by_type`."""
    table = type_table(types)
    rows = [table.cells(row) for row in table.rows]
    cells = [{**{name: one[name] for name in CELL}, "tip": _tip(one)} for one in types]
    return {"cells": cells, "columns": [column.title for column in table.columns], "rows": rows}


def _tip(one: Row) -> str:
    labels = "seen in training" if one["seen"] else "without training labels"
    lines = [f"types {at(one['theta'])}, {labels}"]
    lines += ["outside the range that the game is made for: extrapolated"] if one["extrapolated"] else []
    counts = f"{one['collisions']} of {one['safe_starts']} safe starts collide: {percent(one['rate'])}"
    lines += (
        [counts, f"95 % interval {interval(one['interval'])}"] if one["safe_starts"] else ["no safe start: rate n/a"]
    )
    return "\n".join([*lines, f"median excess cost {signed(one['relative_excess'])}"])


def comparison(recipes: Iterable[Recipe]) -> list[Row]:
    """Pooled rates of recipes with their intervals, each followed by those of its seeds; safest first."""
    played = sorted((one for one in recipes if one.pooled.safe_starts), key=lambda one: one.pooled.rate or 0.0)
    return [{**names_of(recipe), "recipe": recipe.name, **row} for recipe in played for row in _rates(recipe)]


def _rates(recipe: Recipe) -> list[Row]:
    whole, (low, high) = recipe.pooled, recipe.pooled.interval or (None, None)
    tip = f"{recipe.name}, {recipe.seeds}\n{share(whole)}\n95 % interval {interval(whole.interval)}"
    count = f"{whole.collisions:,} of {whole.safe_starts:,}"
    rows: list[Row] = [{"seed": None, "rate": whole.rate, "low": low, "high": high, "count": count, "tip": tip}]
    for run, own in zip(recipe.runs, recipe.by_seed, strict=True):
        worst = f"\nworst type {at(own.worst_theta)}" if own.worst_theta else ""
        rows.append({"seed": run.seed, "rate": own.rate, "tip": f"seed {run.seed}: {share(own)}{worst}"})
    return rows


def learning_curves(recipes: Iterable[Recipe], runs: Iterable[Run]) -> list[Row]:
    """Metrics of every run by step, thinned out evenly; what was logged once is no curve."""
    names = {run.name: recipe.name for recipe in recipes for run in recipe.runs}
    return [
        {
            **names_of(run), "run": run.name,
            "recipe": names.get(run.name, " / ".join((run.operator, run.function, run.activation))),
            "metrics": {name: _thinned(curve) for name, curve in sorted(run.curves.items()) if len(curve) > 1},
        }
        for run in runs
        if any(len(curve) > 1 for curve in run.curves.values())
    ]  # fmt: skip


def _thinned(curve: Sequence[tuple[int, float]]) -> list[tuple[int, float]]:
    kept = np.linspace(0, len(curve) - 1, min(POINTS, len(curve))).round().astype(int)
    return [(curve[k][0], float(f"{curve[k][1]:.{DIGITS}g}")) for k in kept]


def ranked(runs: Iterable[Run]) -> list[tuple[int, Episode]]:
    """Every episode with its run's number: the worst of every run, a typical one of each, then by what was lost."""
    ordered = []
    for k, run in enumerate(runs):
        places = {"worst": 0, "typical": 1}
        own = sorted(run.episodes, key=lambda one: one.order)
        ordered += [(places.pop(one.kind, 2), one.order, k, one) for one in own]
    return [(k, one) for *_, k, one in sorted(ordered, key=lambda entry: entry[:2])]


def entry(found: Episode) -> Row:
    """What the page lists of an episode."""
    flags = {name: True for name in ("collided", "other_side") if getattr(found, name)}
    return {"theta": list(found.theta), "kind": found.kind, "start": found.start, **flags}


def scenes(runs: Iterable[Run]) -> dict[str, Row]:
    """What is drawn around players, by game; the first run of a game whose episodes say it decides."""
    found: dict[str, Row] = {}
    for run in runs:
        if run.episodes and not found.get(run.game, {}).get("players"):
            roads = [road._asdict() for road in run.scene.roads]
            found[run.game] = {**run.scene.model_dump(), "roads": roads}
    return found


def playable(run: Run, found: Episode) -> Row:
    """What the page's player gets of an episode."""
    said = (
        f"{run.name}, types {at(found.theta)}, {found.kind}: {clearance(found, run.constraint_unit)}. {_costs(found)}"
    )
    said += " Passes on the other side than the equilibrium." * found.other_side
    return {**columns(found), "said": said, "closest": closest(found)}


def _costs(found: Episode) -> str:
    if found.lost is None:
        return f"Joint cost {number(found.cost, 1)}, the equilibrium's {number(found.label_cost, 1)}."
    costs = f"joint cost {number(found.cost, 1)}, the equilibrium's {number(found.label_cost, 1)}"
    return f"Lost against the equilibrium: {number(found.lost, 1)} ({costs})."
