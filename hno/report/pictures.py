"""Pictures of runs and recipes: for a run's folder, for dashboards and for documents."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import altair as alt
from PIL import Image

from hno.data.store import replace_whole
from hno.evaluation.outcome import pooled
from hno.report import charts, vega
from hno.report.charts import encounter, separation
from hno.report.episode import Episode, closest, distances, frames, whole
from hno.report.recipes import by_type
from hno.report.records import type_row
from hno.report.verdicts import share

WIDE, HIGH = 420, 170
"""Size of a view of an encounter, px."""
LEGEND = alt.Legend(title="rate", format=".1%", values=[0.001, 0.01, 0.1, 1], gradientLength=120)


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
