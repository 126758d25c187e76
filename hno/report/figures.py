"""Figures and tables for documents: SVG and PNG without a browser, Markdown and JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import altair as alt
import numpy as np
import vl_convert
from numpy.typing import NDArray

from hno.data.store import replace_whole
from hno.report import charts, payload, words
from hno.report.aggregate import Rate, Recipe, best, headline
from hno.report.grouping import recipes
from hno.report.kernels import condition_table
from hno.report.palette import LIGHT, chart_config
from hno.report.parsing import Episode, TypeResult
from hno.report.runs import Sweep
from hno.report.tables import CACHED, Table, recipe_table

WIDE, HIGH = 420, 170
"""Size of a view of an encounter, px."""
KINDS = ("worst", "typical")
LEGEND = alt.Legend(title="rate", format=".1%", values=[0.001, 0.01, 0.1, 1], gradientLength=120)
"""Of the colours of heat maps."""


def write_figures(sweep: Sweep, folder: Path) -> list[Path]:
    """Write what a document about a sweep needs.

    Args:
        sweep: the runs.
        folder: gets `collisions_<game>`, `comparison_<game>` and `encounter_<game>_<kind>_<view>`, each as SVG and as
            PNG, `summary.md` and `summary.json`.

    Returns:
        The files.
    """
    found = recipes(sweep.runs)
    written = []
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
    specification = chart.to_dict()
    specification["config"] = {**chart_config(LIGHT), "background": "white", "aria": False}
    svg = vl_convert.vegalite_to_svg(specification, vl_version=charts.version())
    picture = vl_convert.svg_to_png(svg, scale=2)
    replace_whole(path.with_suffix(".svg"), _writer(svg))
    replace_whole(path.with_suffix(".png"), lambda draft: draft.write_bytes(picture))
    return [path.with_suffix(".svg"), path.with_suffix(".png")]


def collision_figure(found: Sequence[Recipe]) -> alt.ConcatChart | None:
    """One heat map for every recipe of a game, seen types framed; None where there is nothing to show."""
    shown = [recipe for recipe in found if recipe.table and all(len(row.theta) == 2 for row in recipe.table)]
    maps = [
        charts.heat_map(_inline(heat_cells(recipe.table)), LEGEND if k == 0 else None, font=12).properties(
            title=alt.TitleParams(recipe.name, subtitle=_counts(recipe), anchor="start")
        )
        for k, recipe in enumerate(shown)
    ]
    if not maps:
        return None
    title = alt.TitleParams(f"{shown[0].game}: collisions of safe starts in %; framed: types with training labels")
    return alt.concat(*maps, columns=math.isqrt(len(maps) - 1) + 1, spacing=30, title=title)


def _counts(recipe: Recipe) -> list[str]:
    """How many starts and seeds a map is made of, as a whole and type by type."""
    starts = [row.starts for row in recipe.table]
    each = f"{min(starts):,}" if min(starts) == max(starts) else f"{min(starts):,} to {max(starts):,}"
    return [f"{words.share(recipe.rate)}, {words.seeds(recipe)}", f"{each} safe starts per type"]


def _inline(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    return {"values": list(rows)}


def heat_cells(rows: Sequence[TypeResult]) -> list[dict[str, Any]]:
    """Rows for `charts.heat_map`."""
    return [
        {
            "theta_1": row.theta[0],
            "theta_2": row.theta[1],
            "shown": rate,
            "label": _label(rate),
            "seen": row.seen,
        }
        for row in rows
        for rate in [Rate(row.collisions, row.starts).value]
    ]


def _label(rate: float | None) -> str:
    """A rate in %, short enough for a cell."""
    if not rate:
        return "n/a" if rate is None else "0"
    return "<0.1" if rate < 0.0005 else f"{100 * rate:.{1 if rate < 0.0995 else 0}f}"


def comparison_figure(found: Sequence[Recipe]) -> alt.TopLevelMixin | None:
    """Collision rates of the recipes of a game; None where nothing was played."""
    rows = payload.comparison(found)
    return charts.comparison(_inline(rows)).properties(width=WIDE) if rows else None


def encounter_figures(found: Sequence[Recipe]) -> dict[str, alt.TopLevelMixin]:
    """The worst and a typical episode of a game's best recipe at their closest approach, by kind and view."""
    chosen = [recipe for recipe in best(found).values() if any(run.episodes for run in recipe.runs)]
    if not chosen:
        return {}
    recipe = headline(chosen)
    views: dict[str, alt.TopLevelMixin] = {}
    for kind in KINDS:
        own = [episode for run in recipe.runs for episode in run.episodes if episode.kind == kind]
        own.sort(key=payload.clearance)
        if own:
            views |= _views(own[0] if kind == "worst" else own[len(own) // 2], recipe.name)
    return views


def _views(found: Episode, name: str) -> dict[str, alt.TopLevelMixin]:
    gaps = payload.gap(found)
    closest = int(gaps.argmin())
    title = f"{name}, types {words.theta(found.theta)}, {found.kind}: {words.clearance(found.clearance)}"
    return {
        f"{found.kind}_{view}": _view(found, gaps, up, across, closest).properties(
            title=alt.TitleParams(title, anchor="start")
        )
        for view, up, across in (("top", 1, "y"), ("side", 2, "z"))[: found.positions.shape[2] - 1]
    }


def _view(found: Episode, gaps: NDArray[np.float64], up: int, across: str, frame: int) -> alt.TopLevelMixin:
    chart = charts.encounter(
        _inline(_rows(found, found.positions, gaps, up)),
        _inline([] if found.equilibrium is None else _rows(found, found.equilibrium, gaps, up)),
        across,
        frame,
        _window(found, up, frame),
    )
    return chart.properties(width=WIDE, height=HIGH)


def _rows(found: Episode, paths: NDArray[np.float64], gaps: NDArray[np.float64], up: int) -> list[dict[str, float]]:
    return [
        {
            "frame": k, "player": who + 1, "x": float(paths[k, who, 0]), "y": float(paths[k, who, up]),
            "radius": float(found.radius[k]), "gap": float(gaps[k]),
        }
        for who in range(paths.shape[1])
        for k in range(len(paths))
    ]  # fmt: skip


def _window(found: Episode, up: int, frame: int) -> dict[str, float]:
    """The part of space around the players at a frame that fills a view in true proportion."""
    at = found.positions[frame][:, [0, up]]
    centre = (at.min(0) + at.max(0)) / 2
    span = at.max(0) - at.min(0) + 3 * found.radius[frame]
    scale = min(WIDE / span[0], HIGH / span[1])
    half, tall = WIDE / scale / 2, HIGH / scale / 2
    return {
        "left": float(centre[0] - half), "right": float(centre[0] + half),
        "bottom": float(centre[1] - tall), "top": float(centre[1] + tall),
    }  # fmt: skip


def markdown(sweep: Sweep, found: Sequence[Recipe]) -> str:
    """Verdicts and tables."""
    parts = [f"# {sweep.name}", words.jobs(sweep)]
    parts += [f"- **{game}**, {one.name}, {words.share(one.rate)}. {text}" for game, one, text in words.verdicts(found)]
    parts += ["## Recipes", table_text(recipe_table(found)), "## Time", table_text(cost_table(found)), CACHED]
    kernels = condition_table(sweep.runs)
    parts += ["## Condition numbers of the tangent kernel", table_text(kernels)] if kernels.rows else []
    missing = [f"- {run.name}: {words.why(run)}" for run in sweep.runs if not run.finished]
    parts += ["## Without a result", "\n".join(missing)] if missing else []
    parts += ["## How to repeat it", f"```\n{sweep.command}\n```"] if sweep.command else []
    return "\n\n".join(parts) + "\n"


def cost_table(found: Sequence[Recipe]) -> Table:
    """Seconds of every part, means over seeds (the paper's cost table)."""
    columns = ["game", "recipe", "seeds", "labels s", "training s", "total s"]
    table = recipe_table(found)
    places = [table.columns.index(column) for column in columns]
    return Table(columns, [row._replace(cells=[row.cells[k] for k in places]) for row in table.rows])


def table_text(table: Table) -> str:
    """A table in Markdown."""
    lines = [table.columns, ["---"] * len(table.columns), *([cell.text for cell in row.cells] for row in table.rows)]
    return "\n".join(f"| {' | '.join(_plain(text) for text in line)} |" for line in lines)


def _plain(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")


def summary(sweep: Sweep, found: Sequence[Recipe]) -> str:
    """Everything that the tables are made of, as JSON."""
    content = {
        "name": sweep.name,
        "command": sweep.command,
        "recipes": [_recipe(recipe) for recipe in found],
        "missing": [
            {"run": run.name, "status": run.status, "reason": words.why(run)} for run in sweep.runs if not run.finished
        ],
        "skipped": [entry._asdict() for entry in sweep.skipped],
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _recipe(recipe: Recipe) -> dict[str, Any]:
    spreads = {"rate_over_seeds": recipe.rates, "excess": recipe.excess}
    spreads |= {f"seconds_{part}": recipe.seconds(part) for part in ("labels", "training", "total")}
    return {
        "game": recipe.game, "operator": recipe.operator, "activation": recipe.activation, "variant": recipe.variant,
        "conditions": recipe.conditions, "seeds": [run.seed for run in recipe.runs],
        **recipe.rate._asdict(), "rate": recipe.rate.value, "interval": recipe.rate.interval,
        **{name: None if one is None else one._asdict() for name, one in spreads.items()},
        "types": [{**row._asdict(), "interval": Rate(row.collisions, row.starts).interval} for row in recipe.table],
        "unfinished": recipe.unfinished, "failed": recipe.failed,
    }  # fmt: skip
