"""What the page's script works with, as JSON: heat maps, rates of recipes, learning curves and episodes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from hno.evaluation.format import counted
from hno.evaluation.sections import plain
from hno.report.recipes import Recipe, TypeCounts, pool
from hno.report.records import Run
from hno.report.tables import names_of
from hno.report.verdicts import at, rate

POINTS = 120
"""Points of a learning curve, at most."""


def cells(rows: Sequence[TypeCounts]) -> list[dict[str, Any]]:
    """Rows of a heat map."""
    return [
        one._asdict()
        | {
            "interval": one.interval and [round(bound, 5) for bound in one.interval],
            "relative_excess": None if one.relative_excess is None else round(one.relative_excess, 4),
            "rate": None if one.rate is None else round(one.rate, 6),
        }
        for one in rows
    ]


def comparison(recipes: Iterable[Recipe]) -> list[dict[str, Any]]:
    """Pooled rates of recipes and those of their seeds, safest first."""
    played = [recipe for recipe in recipes if recipe.pooled.safe_starts]
    return [entry for recipe in sorted(played, key=lambda one: one.pooled.rate or 0.0) for entry in _compared(recipe)]


def _compared(recipe: Recipe) -> list[dict[str, Any]]:
    names = {**names_of(recipe, "any"), "recipe": recipe.name}
    whole = recipe.pooled
    low, high = whole.interval or (None, None)
    tip = f"{recipe.name}, {counted(len(recipe.runs), 'seed')}\n{rate(whole)}"
    count = f"{whole.collisions:,} of {whole.safe_starts:,}"
    pooled = {"seed": None, "rate": whole.rate, "low": low, "high": high, "count": count, "tip": tip}
    return [{**names, **pooled}, *({**names, **_seed(run)} for run in recipe.runs)]


def _seed(run: Run) -> dict[str, Any]:
    whole, seed = pool(run.table), plain(run.seed)
    worst = "" if whole.worst_theta is None else f"\nworst type {at(whole.worst_theta)}"
    return {"seed": seed, "rate": whole.rate, "tip": f"seed {seed}: {rate(whole)}{worst}"}


def learning_curves(recipes: Iterable[Recipe], runs: Iterable[Run]) -> list[dict[str, Any]]:
    """Metrics of every run by step, thinned out evenly."""
    names = {run.name: recipe.name for recipe in recipes for run in recipe.runs}
    return [
        {
            **names_of(run, "any"),
            "run": run.name,
            "recipe": names.get(run.name, f"{run.operator} / {run.activation}"),
            "metrics": {name: _thinned(curve) for name, curve in sorted(run.curves.items())},
        }
        for run in runs
        if run.curves
    ]


def _thinned(curve: Sequence[tuple[int, float]]) -> list[list[float]]:
    kept = np.unique(np.linspace(0, len(curve) - 1, min(POINTS, len(curve))).round().astype(int))
    return [[curve[k][0], float(f"{curve[k][1]:.4g}")] for k in kept]
