"""Charts of one episode: where players go, and how far they stay apart."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import altair as alt

from hno.report.vega import Layers, colors

WHOLE = {"left": 0.0, "right": 10.0, "bottom": 0.0, "top": 10.0}
"""Signals of `encounter`: the part of space in which everything happens, m."""


def encounter(
    frames: Any, up: Literal["y", "z"], frame: int = 0, follow: bool = True, whole: Mapping[str, float] = WHOLE
) -> Layers:
    """Players on their way, seen from above or from the side, in true proportion.

    The disc around a player has half the collision radius: discs that overlap are a collision.

    Args:
        frames: data named "frames", see `episodes.frames`.
        up: the second axis.
        frame: the one shown.
        follow: whether to show what surrounds the players at that frame rather than everything.
        whole: left, right, bottom and top of everything, m.
    """
    params = [alt.param(name=name, value=value) for name, value in {"frame": frame, "follow": follow, **whole}.items()]
    params += [alt.param(name=name, expr=expression) for name, expression in _window(up).items()]
    scales = [
        alt.Scale(
            domain=[alt.expr(f"{at} - {side} / metre / 2"), alt.expr(f"{at} + {side} / metre / 2")],
            nice=False,
            zero=False,
        )
        for at, side in (("middle_x", "width"), ("middle_y", "height"))
    ]
    x = alt.X("x:Q", title="x [m]", scale=scales[0], axis=alt.Axis(grid=False, tickCount=6))
    y = alt.Y("y:Q", title=f"{up} [m]", scale=scales[1], axis=alt.Axis(grid=False, tickCount=4))
    who, order = alt.Color("player:N", legend=None), alt.Order("frame:Q")
    played = _paths(frames, "x", up).encode(x, y, who)
    now = played.transform_filter("datum.frame === frame")
    expected = _paths(frames, "label_x", f"label_{up}").mark_line(
        strokeDash=[5, 4], strokeWidth=1.5, opacity=0.55, clip=True
    )
    trail = played.mark_line(strokeWidth=2.5, clip=True, strokeCap="round").transform_filter("datum.frame <= frame")
    size = alt.expr("PI * pow(metre * datum.radius / 2, 2)")
    own, danger = alt.expr("scale('color', datum.player)"), alt.expr("danger")
    apart = now.transform_filter("datum.distance >= datum.radius && datum.radius !== null")
    struck = now.transform_filter("datum.distance < datum.radius && datum.radius !== null")
    return (
        alt.layer(
            expected.encode(x, y, who, order),
            trail.encode(order),
            apart.mark_point(filled=True, stroke=own, size=size, fillOpacity=0.22, opacity=1, clip=True),
            struck.mark_point(fill=danger, stroke=danger, size=size, fillOpacity=0.5, opacity=1, clip=True).encode(
                color=alt.Undefined
            ),
            now.mark_point(filled=True, size=30, opacity=1, clip=True),
        )
        .properties(width=420, height=170)
        .add_params(*colors(), *params)
    )


def _window(up: str) -> dict[str, str]:
    """Signals for the part of space in view: its middle, and the px of a metre."""
    now = "data('frames')[frame]"
    room = f"1.5 * ({now}.radius || 1)"
    span = {
        f"near_{axis}": f"[extent({now}.{field})[0] - {room}, extent({now}.{field})[1] + {room}]"
        for axis, field in (("x", "x"), ("y", up))
    }
    return span | {
        "shown_x": "follow ? near_x : [left, right]",
        "shown_y": "follow ? near_y : [bottom, top]",
        "metre": "min(width / (shown_x[1] - shown_x[0]), height / (shown_y[1] - shown_y[0]))",
        "middle_x": "(shown_x[0] + shown_x[1]) / 2",
        "middle_y": "(shown_y[0] + shown_y[1]) / 2",
    }


def _paths(frames: Any, x: str, y: str) -> alt.Chart:
    """One row for every player and frame, from a list of all players in every frame; none where there is no list."""
    return (
        alt.Chart(frames)
        .transform_filter(f"isValid(datum.{x})")
        .transform_calculate(player=f"sequence(1, length(datum.{x}) + 1)", x=f"datum.{x}", y=f"datum.{y}")
        .transform_flatten(["player", "x", "y"])
    )


def separation(frames: Any, frame: int = 0, reach: float = 10.0) -> Layers:
    """Distance between players over time, with the distance below which it is a collision.

    Args:
        frames: see `episodes.frames`.
        frame: the one marked.
        reach: largest distance shown, m.
    """
    base = alt.Chart(frames).encode(x=alt.X("t:Q", title="t [s]", axis=alt.Axis(grid=False, tickCount=5)))
    scale = alt.Scale(domain=[0, alt.expr("reach")], nice=False)
    height = alt.Y("distance:Q", title="distance [m]", scale=scale, axis=alt.Axis(grid=False, tickCount=4))
    forbidden = base.mark_area(color=alt.expr("danger"), opacity=0.12).encode(y="radius:Q")
    edge = base.mark_line(color=alt.expr("danger"), strokeWidth=1.2).encode(y="radius:Q")
    line = base.mark_line(color=alt.expr("ink"), strokeWidth=1.8, clip=True).encode(y=height)
    now = base.transform_filter("datum.frame === frame")
    cursor = now.mark_rule(color=alt.expr("muted"), strokeDash=[3, 3])
    near = "datum.radius !== null && datum.distance < datum.radius ? danger : ink"
    dot = now.mark_circle(size=60, opacity=1, clip=True, color=alt.expr(near)).encode(y=height)
    return (
        alt.layer(forbidden, edge, line, cursor, dot)
        .properties(width="container", height=110)
        .add_params(*colors(), alt.param(name="frame", value=frame), alt.param(name="reach", value=reach))
    )
