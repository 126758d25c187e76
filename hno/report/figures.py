"""Figures and tables for documents: SVG and PNG without a browser, and Markdown."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import altair as alt

from hno.data.store import replace_whole
from hno.evaluation.format import NOT_AVAILABLE, significant
from hno.evaluation.sections import plain
from hno.evaluation.spectrum import Ratio, condition_ratios
from hno.report import charts, vega
from hno.report.episode import closest
from hno.report.page_data import comparison, ranked
from hno.report.pictures import WIDE, rates, views
from hno.report.recipes import Recipe, best, headline, recipes
from hno.report.records import Run
from hno.report.runs import Sweep
from hno.report.tables import CACHED, Table, mapping_table, recipe_table
from hno.report.verdicts import at, clearance, jobs, share, verdict, why

REFERENCE = "tanh"
"""The activation whose condition numbers are divided by those of the others."""


def write_figures(sweep: Sweep, folder: Path) -> list[Path]:
    """Write charts of every game, each as SVG and as PNG, and `summary.md` into a folder, and return the files."""
    found = recipes(sweep.runs)
    content = {"summary.md": markdown(sweep, found).encode()}
    for game in sorted({recipe.game for recipe in found}):
        for name, chart in _charts(game, [recipe for recipe in found if recipe.game == game]).items():
            content |= {f"{name}.svg": vega.svg(chart).encode(), f"{name}.png": vega.png(chart)}
    for name, data in content.items():
        replace_whole(folder / name, functools.partial(Path.write_bytes, data=data))
    return [folder / name for name in content]


def _charts(game: str, found: Sequence[Recipe]) -> dict[str, alt.TopLevelMixin]:
    """Charts of a game: heat maps and rates of all recipes, and encounters of the best one."""
    shown = [recipe for recipe in found if recipe.types and all(len(one["theta"]) == 2 for one in recipe.types)]
    maps = [rates(recipe.types, recipe.name, number) for number, recipe in enumerate(shown)]
    drawn: dict[str, alt.TopLevelMixin] = {}
    if maps:
        title = f"{game}: collisions of safe starts in %; framed: types with training labels"
        drawn[f"collisions_{game}"] = alt.concat(*maps, columns=math.isqrt(len(maps) - 1) + 1, spacing=30, title=title)
    if rows := comparison(found):
        drawn[f"comparison_{game}"] = charts.comparison(vega.inline(rows)).properties(width=WIDE)
    chosen = headline(recipe for recipe in best(found) if any(run.episodes for run in recipe.runs))
    return drawn | (_encounters(chosen) if chosen else {})


def _encounters(recipe: Recipe) -> dict[str, alt.TopLevelMixin]:
    """The worst and a typical episode at their closest approach, by kind and view."""
    found: dict[str, alt.TopLevelMixin] = {}
    ordered = sorted((one for _, one in ranked(recipe.runs)), key=lambda one: one.order)
    for kind in ("worst", "typical"):
        if own := [one for one in ordered if one.kind == kind]:
            one = own[0] if kind == "worst" else own[len(own) // 2]
            near = clearance(one, recipe.runs[0].constraint_unit)
            drawn = views(one, closest(one), True, f"{recipe.name}, types {at(one.theta)}, {kind}: {near}")
            found |= {f"encounter_{recipe.game}_{kind}_{view}": chart for view, chart in drawn.items()}
    return found


def markdown(sweep: Sweep, found: Sequence[Recipe]) -> str:
    """Verdicts and tables."""
    blocks = [f"# {sweep.name}", jobs(sweep)]
    blocks += [f"- **{one.game}**, {one.name}, {share(one.pooled)}. {verdict(one, found)}" for one in best(found)]
    blocks += ["## Recipes", table_text(recipe_table(found)), CACHED]
    ratios = ratio_table(sweep.runs)
    blocks += ["## Ratios of condition numbers of the tangent kernel", table_text(ratios)] if ratios.rows else []
    missing = [f"- {run.name}: {_plain(why(run))}" for run in sweep.runs if not run.finished]
    blocks += ["## Without a result", "\n".join(missing)] if missing else []
    blocks += ["## How to repeat it", f"```\n{sweep.command}\n```"] if sweep.command else []
    return "\n\n".join(blocks) + "\n"


def table_text(table: Table) -> str:
    """A table in Markdown."""
    lines = [[column.title for column in table.columns], ["---"] * len(table.columns), *table.texts]
    return "\n".join(f"| {' | '.join(_plain(text) for text in line)} |" for line in lines)


def _plain(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")


def ratio_table(runs: Sequence[Run]) -> Table:
    """Condition numbers of an activation over those of the others (the paper's table of activations), by type.

    Only runs of one game, operator and seed are compared; several of one activation are told apart by their names.
    """
    groups: dict[tuple[str, str, str], list[Run]] = {}
    for run in runs:
        if run.finished and run.entries.get("ntk"):
            groups.setdefault((run.game, run.operator, plain(run.seed)), []).append(run)
    return mapping_table([row for key, same in sorted(groups.items()) for row in _ratio_rows(key, same)])


def _ratio_rows(key: tuple[str, str, str], runs: Sequence[Run]) -> list[dict[str, Any]]:
    activations = [run.activation for run in runs]
    sections = {
        run.activation if activations.count(run.activation) == 1 else f"{run.activation} ({run.name})": run.entries[
            "ntk"
        ]
        for run in runs
    }
    try:
        found = condition_ratios(sections, REFERENCE)
    except (LookupError, TypeError, ValueError):  # nothing to compare, other points, or a damaged section
        return []
    return [
        dict(zip(("game", "operator", "seed"), key, strict=True))
        | {"types": at(one["theta"]), "kernel": name}
        | {f"{REFERENCE} / {other}": _ratio(ratio) for other, ratio in one[kind].items()}
        for one in found
        for kind, name in (("kernel", "J J'"), ("product", "trunk times branch"))
    ]


def _ratio(found: Ratio) -> str:
    return NOT_AVAILABLE if found.value is None else f"{found.bound} {significant(found.value)}".removeprefix("= ")
