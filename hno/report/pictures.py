"""Pictures of one run, for its folder and for dashboards."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import altair as alt
from PIL import Image

from hno.data.store import replace_whole
from hno.report import charts, episodes, vega
from hno.report.episode import Episode
from hno.report.episode_charts import encounter, separation
from hno.report.recipes import by_type
from hno.report.records import type_row

WIDE, HIGH = 420, 170
"""Size of a view of an encounter, px."""
LEGEND = alt.Legend(title="rate", format=".1%", values=[0.001, 0.01, 0.1, 1], gradientLength=120)
"""Of the colours of heat maps."""


def collision_map(table: Sequence[Any], path: Path, title: str) -> None:
    """Draw the collision rate of every evaluated pair of types with its number of safe starts; seen types are framed.

    Args:
        table: rows of results.json's `table`.
        path: PNG file to write.
        title: lines above the picture.

    Raises:
        ValueError: there are no rows, or the game does not have two players.
    """
    counts = by_type(map(type_row, table))
    if not counts or any(len(one.theta) != 2 for one in counts):
        raise ValueError("A map over types needs evaluated types of two players.")
    rows = [one._asdict() for one in counts]
    chart = charts.heat_map(vega.inline(rows), cell=52, legend=LEGEND, counts=True)
    picture = vega.png(
        chart.properties(title=_title(title, "collisions of safe starts in %; framed: types with labels"))
    )
    replace_whole(path, lambda draft: draft.write_bytes(picture))


def view(found: Episode, up: Literal["y", "z"], frame: int, follow: bool, title: str = "") -> vega.Layers:
    """An episode at a frame, from above ("y") or from the side ("z"). See `episode_charts.encounter`."""
    data = vega.inline(episodes.frames(found), "frames")
    whole = episodes.whole(found, "xyz".index(up))
    chart = encounter(data, up, frame, follow, whole).properties(width=WIDE, height=HIGH)
    return chart.properties(title=_title(title)) if title else chart


def rollout_picture(found: Episode, path: Path, title: str) -> None:
    """Draw one episode: where players go, with discs where they are closest, and how far they stay apart.

    Args:
        found: the episode.
        path: PNG file to write.
        title: lines above the picture.
    """
    frame = episodes.closest(found)
    drawn = [view(found, up, frame, follow=False, title="" if k else title) for k, up in enumerate(sides(found))]
    if episodes.distances(found) is not None:
        data = vega.inline(episodes.frames(found), "frames")
        drawn.append(separation(data, frame, episodes.reach(found)).properties(width=WIDE))
    picture = _stacked(drawn)
    replace_whole(path, lambda draft: picture.save(draft, format="PNG"))


def sides(found: Episode) -> Sequence[Literal["y", "z"]]:
    """The second axis of every view."""
    return ("y", "z") if found.positions.shape[2] == 3 else ("y",)


def _stacked(drawn: Sequence[vega.Layers]) -> Image.Image:
    """Charts below each other."""
    images = [Image.open(io.BytesIO(vega.png(chart))).convert("RGB") for chart in drawn]
    size = max(image.width for image in images), sum(image.height for image in images)
    picture, top = Image.new("RGB", size, "white"), 0
    for image in images:
        picture.paste(image, (size[0] - image.width, top))
        top += image.height
    return picture


def _title(text: str, subtitle: str | alt.UndefinedType = alt.Undefined) -> alt.TitleParams:
    return alt.TitleParams(text.splitlines(), subtitle=subtitle, anchor="start")
