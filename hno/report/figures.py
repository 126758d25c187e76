"""Figures and tables for documents: SVG and PNG without a browser, Markdown and JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import altair as alt

from hno.data.store import replace_whole
from hno.report import charts, episodes, vega
from hno.report.condition_numbers import condition_table
from hno.report.episode import Episode
from hno.report.page_data import comparison
from hno.report.pictures import LEGEND, WIDE, sides, view
from hno.report.recipes import Recipe, best, headline, recipes
from hno.report.runs import Sweep
from hno.report.tables import CACHED, COST, Table, recipe_table
from hno.report.verdicts import at, clearance, jobs, seeds, share, verdicts, why


def write_figures(sweep: Sweep, folder: Path) -> list[Path]:
    """Write what a document about a sweep needs.

    Args:
        sweep: the runs.
        folder: gets `collisions_<game>`, `comparison_<game>` and `encounter_<game>_<kind>_<view>`, each as SVG and as
            PNG, `summary.md` and `summary.json`.

    Returns:
        The files.
    """
    found, written = recipes(sweep.runs), list[Path]()
    for game in sorted({recipe.game for recipe in found}):
        own = [recipe for recipe in found if recipe.game == game]
        drawn = {f"collisions_{game}": collision_figure(own), f"comparison_{game}": comparison_figure(own)}
        drawn |= {f"encounter_{game}_{name}": chart for name, chart in encounter_figures(own).items()}
        for name, chart in drawn.items():
            written += [] if chart is None else _draw(chart, folder / name)
    for name, text in (("summary.md", markdown(sweep, found)), ("summary.json", summary(sweep, found))):
        written.append(folder / name)
        replace_whole(folder / name, _writer(text))
    return written


def _writer(text: str) -> Callable[[Path], object]:
    return lambda draft: draft.write_text(text, encoding="utf-8")


def _draw(chart: alt.TopLevelMixin, path: Path) -> list[Path]:
    picture = vega.png(chart)
    replace_whole(path.with_suffix(".svg"), _writer(vega.svg(chart)))
    replace_whole(path.with_suffix(".png"), lambda draft: draft.write_bytes(picture))
    return [path.with_suffix(".svg"), path.with_suffix(".png")]


def collision_figure(found: Sequence[Recipe]) -> alt.TopLevelMixin | None:
    """One heat map for every recipe of a game, seen types framed; None where there is nothing to show."""
    shown = [recipe for recipe in found if recipe.types and all(len(one.theta) == 2 for one in recipe.types)]
    maps = [
        charts.heat_map(
            vega.inline([one._asdict() for one in recipe.types], f"cells_{k}"), legend=None if k else LEGEND
        ).properties(title=alt.TitleParams(recipe.name, subtitle=_counts(recipe), anchor="start"))
        for k, recipe in enumerate(shown)
    ]
    if not maps:
        return None
    title = alt.TitleParams(f"{shown[0].game}: collisions of safe starts in %; framed: types with training labels")
    return alt.concat(*maps, columns=math.isqrt(len(maps) - 1) + 1, spacing=30, title=title)


def _counts(recipe: Recipe) -> list[str]:
    """How many starts and seeds a map is made of, as a whole and type by type."""
    starts = [one.safe_starts for one in recipe.types]
    each = f"{min(starts):,}" if min(starts) == max(starts) else f"{min(starts):,} to {max(starts):,}"
    return [f"{share(recipe.pooled)}, {seeds(recipe)}", f"{each} safe starts per type"]


def comparison_figure(found: Sequence[Recipe]) -> alt.TopLevelMixin | None:
    """Collision rates of the recipes of a game; None where nothing was played."""
    rows = comparison(found)
    return charts.comparison(vega.inline(rows)).properties(width=WIDE) if rows else None


def encounter_figures(found: Sequence[Recipe]) -> dict[str, alt.TopLevelMixin]:
    """The worst and a typical episode of a game's best recipe at their closest approach, by kind and view."""
    chosen = [recipe for recipe in best(found).values() if any(run.episodes for run in recipe.runs)]
    if not chosen:
        return {}
    recipe, views = headline(chosen), dict[str, alt.TopLevelMixin]()
    ordered = [one for _, one in episodes.ranked(recipe.runs)]
    for kind in ("worst", "typical"):
        own = sorted((one for one in ordered if one.kind == kind), key=episodes.by_clearance)
        if own:
            views |= _views(own[0] if kind == "worst" else own[len(own) // 2], recipe)
    return views


def _views(found: Episode, recipe: Recipe) -> dict[str, alt.TopLevelMixin]:
    near = clearance(found, recipe.runs[0].constraint_unit)
    title = f"{recipe.name}, types {at(found.theta)}, {found.kind}: {near}"
    names, frame = {"y": "top", "z": "side"}, episodes.closest(found)
    return {f"{found.kind}_{names[up]}": view(found, up, frame, True, title) for up in sides(found)}


def markdown(sweep: Sweep, found: Sequence[Recipe]) -> str:
    """Verdicts and tables."""
    blocks = [f"# {sweep.name}", jobs(sweep)]
    blocks += [f"- **{one.game}**, {one.name}, {share(one.pooled)}. {text}" for one, text in verdicts(found)]
    table = recipe_table(found)
    blocks += ["## Recipes", table_text(table), "## Time", table_text(table._replace(columns=COST)), CACHED]
    kernels = condition_table(sweep.runs)
    blocks += ["## Condition numbers of the tangent kernel", table_text(kernels)] if kernels.rows else []
    missing = [f"- {run.name}: {why(run)}" for run in sweep.runs if not run.finished]
    blocks += ["## Without a result", "\n".join(missing)] if missing else []
    blocks += ["## How to repeat it", f"```\n{sweep.command}\n```"] if sweep.command else []
    return "\n\n".join(blocks) + "\n"


def table_text(table: Table) -> str:
    """A table in Markdown."""
    lines = [[column.title for column in table.columns], ["---"] * len(table.columns), *table.texts]
    return "\n".join(f"| {' | '.join(_plain(text) for text in line)} |" for line in lines)


def _plain(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")


def summary(sweep: Sweep, found: Sequence[Recipe]) -> str:
    """Everything that the tables are made of, as JSON."""
    missing = [{"run": run.name, "status": run.status, "reason": why(run)} for run in sweep.runs if not run.finished]
    content = {
        "name": sweep.name,
        "command": sweep.command,
        "recipes": [_recipe(recipe) for recipe in found],
        "missing": missing,
        "skipped": [entry._asdict() for entry in sweep.skipped],
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _recipe(recipe: Recipe) -> dict[str, Any]:
    spreads = {"rate_over_seeds": recipe.rates, "excess": recipe.excess}
    counts = {name: value for name, value in recipe.pooled._asdict().items() if name != "relative_excess"}
    spreads |= {f"seconds_{stage}": recipe.seconds(stage) for stage in ("labels", "training", "total")}
    return {
        "game": recipe.game, "operator": recipe.operator, "activation": recipe.activation, "variant": recipe.variant,
        "conditions": recipe.conditions, "seeds": [run.seed for run in recipe.runs], **counts,
        **{name: None if one is None else one._asdict() for name, one in spreads.items()},
        "types": [one._asdict() for one in recipe.types],
        "unfinished": recipe.unfinished, "failed": recipe.failed,
    }  # fmt: skip
