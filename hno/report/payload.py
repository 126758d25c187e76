"""What the page's script works with: heat maps, learning curves and episodes as compact JSON, within budgets."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hno.report.aggregate import Rate, Recipe, excess, worst
from hno.report.parsing import Episode, TypeResult
from hno.report.runs import Run
from hno.report.words import rate, theta

CURVE_BYTES = 500_000
MAP_BYTES = 700_000
POINTS = 120
"""Most points of a learning curve; fewer where there are many runs."""


class Budgeted(NamedTuple):
    """What fits into a budget."""

    content: list[Any]
    shown: int
    total: int


def size(content: Any) -> int:
    """Bytes of compact JSON."""
    return len(json.dumps(content, separators=(",", ":")))


def heat_map(rows: Sequence[TypeResult]) -> list[list[Any]]:
    """Cells of a heat map: types, collisions, starts, seen, relative excess cost, extrapolated."""
    return [
        [list(row.theta), row.collisions, row.starts, int(row.seen), _rounded(excess([row]), 4), int(row.extrapolated)]
        for row in rows
    ]


def intervals(found: Iterable[Sequence[TypeResult]]) -> dict[str, tuple[float, ...]]:
    """Bounds of the collision rate by "collisions/starts", which many types share."""
    counts = {Rate(row.collisions, row.starts) for rows in found for row in rows if row.starts}
    return {f"{c.collisions}/{c.starts}": tuple(round(bound, 5) for bound in c.interval or ()) for c in sorted(counts)}


def comparison(recipes: Iterable[Recipe]) -> list[dict[str, Any]]:
    """Pooled rates of recipes and those of their seeds, safest first."""
    ordered = sorted((recipe for recipe in recipes if recipe.rate.starts), key=lambda recipe: recipe.rate.value or 0.0)
    return [entry for recipe in ordered for entry in _compared(recipe)]


def _compared(recipe: Recipe) -> list[dict[str, Any]]:
    names = {"game": recipe.game, "operator": recipe.operator, "activation": recipe.activation, "recipe": recipe.name}
    low, high = recipe.rate.interval or (None, None)
    pooled = {**names, "seed": None, "rate": recipe.rate.value, "low": low, "high": high}
    pooled["count"] = f"{recipe.rate.collisions:,} of {recipe.rate.starts:,}"
    pooled["tip"] = f"{recipe.name}, {len(recipe.runs)} seeds\n{rate(recipe.rate)}"
    return [pooled, *({**names, **entry} for entry in map(_seed, recipe.runs))]


def _seed(run: Run) -> dict[str, Any]:
    counts = Rate(sum(row.collisions for row in run.table), sum(row.starts for row in run.table))
    low, high = counts.interval or (None, None)
    most = worst(run.table)
    at = "" if most is None or not most.collisions else f"\nworst type {theta(most.theta)}"
    seed = "n/a" if run.seed is None else run.seed
    return {"seed": seed, "rate": counts.value, "low": low, "high": high, "tip": f"seed {seed}: {rate(counts)}{at}"}


def learning_curves(runs: Sequence[Run], names: dict[str, str], budget: int = CURVE_BYTES) -> Budgeted:
    """Metrics by step, thinned out evenly until they fit.

    Args:
        runs: with curves.
        names: recipe of each run, by the run's name.
        budget: bytes.
    """
    told = [run for run in runs if run.curves]
    points = POINTS
    while True:
        content = [_curve(run, names.get(run.name, ""), points) for run in told]
        if size(content) <= budget or points <= 4:
            break
        points //= 2
    return _within(content, budget, len(content))


def _curve(run: Run, recipe: str, points: int) -> dict[str, Any]:
    thinned = {}
    for name, (steps, values) in sorted(run.curves.items()):
        kept = np.unique(np.linspace(0, len(steps) - 1, min(points, len(steps))).round().astype(int))
        thinned[name] = [[steps[k] for k in kept], [float(f"{values[k]:.4g}") for k in kept]]
    return {**identity(run), "recipe": recipe, "metrics": thinned}


def identity(run: Run) -> dict[str, Any]:
    """What a run is filtered by, and its name."""
    return {
        "run": run.name, "game": run.game, "operator": run.operator, "activation": run.activation,
        "seed": "n/a" if run.seed is None else run.seed,
    }  # fmt: skip


def episodes(runs: Sequence[Run], budget: int) -> Budgeted:
    """Episodes that fit into a budget: the worst and a typical one of every run first, then by clearance."""
    ranked: list[tuple[int, float, Run, Episode]] = []
    for run in runs:
        ordered = sorted(run.episodes, key=clearance)
        first = {id(next((e for e in ordered if e.kind == kind), None)) for kind in ("worst", "typical")}
        ranked += [(2 * (id(e) not in first) + (e.kind != "worst"), clearance(e), run, e) for e in ordered]
    ranked.sort(key=lambda entry: entry[:2])
    return _within((_episode(run, found) for _, _, run, found in ranked), budget, len(ranked))


def clearance(found: Episode) -> float:
    """What episodes are ranked by; without a clearance they come last."""
    return np.inf if found.clearance is None else found.clearance


def _episode(run: Run, found: Episode) -> dict[str, Any]:
    gaps = gap(found)
    return {
        **identity(run), "theta": list(found.theta), "kind": found.kind, "collided": found.collided,
        "clearance": _rounded(found.clearance, 3), "cost": _rounded(found.cost, 2),
        "label_cost": _rounded(found.label_cost, 2),
        "t": _deltas(found.t, 1000), "radius": _deltas(found.radius, 1000), "gap": _deltas(gaps, 1000),
        "positions": _paths(found.positions), "ghost": None if found.equilibrium is None else _paths(found.equilibrium),
    }  # fmt: skip


def gap(found: Episode) -> NDArray[np.float64]:
    """Distance between the closest players minus the collision radius, m, (F,)."""
    apart = np.linalg.norm(found.positions[:, :, None] - found.positions[:, None], axis=-1)
    players = apart.shape[1]
    apart[:, range(players), range(players)] = np.inf
    return apart.min((1, 2)) - found.radius


def _paths(positions: NDArray[np.float64]) -> list[list[list[int]]]:
    """Positions by player and axis, cm, as differences from frame to frame."""
    return [[_deltas(axis, 100) for axis in player.T] for player in positions.transpose(1, 0, 2)]


def _deltas(values: NDArray[np.float64], scale: int) -> list[int]:
    """Whole multiples of 1 / scale: the first one, then differences."""
    whole = np.nan_to_num(values * scale, posinf=1e9, neginf=-1e9).round().astype(int)
    return np.diff(whole, prepend=0).tolist()


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)


def _within(entries: Iterable[Any], budget: int, total: int) -> Budgeted:
    kept, spent = [], 0
    for entry in entries:
        spent += size(entry) + 1
        if spent > budget:
            break
        kept.append(entry)
    return Budgeted(kept, len(kept), total)


def maps(entries: Sequence[tuple[str, Sequence[TypeResult]]], budget: int = MAP_BYTES) -> dict[str, Any]:
    """Heat maps by their identifier, the first ones until the budget is spent."""
    found = _within(({"id": name, "cells": heat_map(rows)} for name, rows in entries), budget, len(entries))
    return {entry["id"]: entry["cells"] for entry in found.content}
