"""Pictures of runs, for their folders and dashboards; figures of recipes and a summary in Markdown, for documents."""

from __future__ import annotations

import functools
import io
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import altair as alt
from PIL import Image

from hno.data.store import replace_whole
from hno.evaluation.format import NOT_AVAILABLE, at, significant
from hno.evaluation.outcome import pooled
from hno.evaluation.sections import plain
from hno.evaluation.spectrum import Ratio, condition_ratios
from hno.report import charts, vega
from hno.report.charts import encounter
from hno.report.episode import Episode, closest, distances, frames, whole
from hno.report.page_data import comparison, ranked
from hno.report.recipes import Recipe, best, by_type, headline, recipes
from hno.report.records import Run, type_row
from hno.report.runs import Sweep
from hno.report.strips import separation
from hno.report.tables import CACHED, Table, mapping_table, recipe_table
from hno.report.verdicts import clearance, jobs, share, verdict, why

WIDE, HIGH = 420, 170
"""Size of a view of an encounter, px."""
LEGEND = alt.Legend(title="rate", format=".1%", values=[0.001, 0.01, 0.1, 1], gradientLength=120)
REFERENCE = "tanh"
"""The activation whose condition numbers are divided by those of the others."""


def rates(types: Sequence[Mapping[str, Any]], title: str, number: int = 0) -> vega.Layers:
    """A heat map with its counts above it; of several in a figure, the first, number 0, has the legend of all."""
    starts = [one["safe_starts"] for one in types]
    each = " to ".join(f"{count:,}" for count in sorted({min(starts), max(starts)}))
    counts = [f"{share(pooled(types))}", f"{each} safe starts per type"]
    chart = charts.heat_map(vega.inline(types, f"cells_{number}"), None if number else LEGEND)
    return chart.properties(title=alt.TitleParams(title.splitlines(), subtitle=counts, anchor="start"))


def collision_map(table: Sequence[Any], path: Path, title: str) -> None:
    """Draw the rates of results.json's `table` into a PNG file; types with training labels are framed.

    Raises:
        ValueError: there are no rows, or the game does not have two players.
    """
    types = by_type(map(type_row, table))
    if not types or any(len(one["theta"]) != 2 for one in types):
        raise ValueError("A map over types needs evaluated types of two players.")
    picture = vega.png(rates(types, title))
    replace_whole(path, lambda draft: draft.write_bytes(picture))


def views(found: Episode, frame: int, follow: bool, title: str) -> dict[str, vega.Layers]:
    """An episode at a frame, from above ("top") and, in space, from the side ("side"). See `encounter`."""
    data, axes = vega.inline(frames(found), "frames"), dict[str, Literal["y", "z"]](top="y", side="z")
    return {
        name: encounter(data, axes[name], frame, follow, whole(found, up)).properties(
            width=WIDE, height=HIGH, title=alt.TitleParams(title.splitlines(), anchor="start")
        )
        for up, name in enumerate(list(axes)[: found.positions.shape[2] - 1], start=1)
    }


def rollout_picture(found: Episode, path: Path, title: str) -> None:
    """Draw into a PNG file where players go, with discs where they are closest, and how far they stay apart."""
    frame = closest(found)
    drawn = list(views(found, frame, False, title).values())
    if distances(found) is not None:
        drawn.append(separation(vega.inline(frames(found), "frames"), frame).properties(width=WIDE))
    images = [Image.open(io.BytesIO(vega.png(chart))).convert("RGB") for chart in drawn]
    picture, top = Image.new("RGB", (max(one.width for one in images), sum(one.height for one in images)), "white"), 0
    for image in images:
        picture.paste(image, (picture.width - image.width, top))
        top += image.height
    replace_whole(path, lambda draft: picture.save(draft, format="PNG"))


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

    Only runs of one game, operator, function and seed are compared; several of one activation have their names beside.
    """
    groups: dict[tuple[str, ...], list[Run]] = {}
    for run in runs:
        if run.finished and run.entries.get("ntk"):
            groups.setdefault((run.game, run.operator, run.function, plain(run.seed)), []).append(run)
    rows = list[dict[str, Any]]()
    for key, same in sorted(groups.items()):
        known, counts = (
            dict(zip(("game", "operator", "function", "seed"), key, strict=True)),
            Counter(run.activation for run in same),
        )
        names = [run.activation + f" ({run.name})" * (counts[run.activation] > 1) for run in same]
        sections = {name: run.entries["ntk"] for name, run in zip(names, same, strict=True)}
        with suppress(LookupError, TypeError, ValueError):  # nothing to compare, other points, or a damaged section
            for one in condition_ratios(sections, REFERENCE):
                for kind, name in (("kernel", "J J'"), ("product", "trunk times branch")):
                    ratios = {f"{REFERENCE} / {other}": _ratio(ratio) for other, ratio in one[kind].items()}
                    rows.append({**known, "types": at(one["theta"]), "kernel": name, **ratios})
    return mapping_table(rows)


def _ratio(found: Ratio) -> str:
    return NOT_AVAILABLE if found.value is None else f"{found.bound} {significant(found.value)}".removeprefix("= ")
