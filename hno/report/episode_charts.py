"""Charts of one episode: where players go, and how far they stay apart."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import altair as alt

from hno.report.vega import Layers, colors

WHOLE = {"left": 0.0, "right": 10.0, "bottom": 0.0, "top": 10.0}
"""Signals of `encounter`: the part of space in which everything happens, m."""
STRUCK = "datum.radius !== null && datum.distance < datum.radius"


def encounter(
    frames: Any, up: Literal["y", "z"], frame: int = 0, follow: bool = True, whole: Mapping[str, float] = WHOLE
) -> Layers:
    """Players on their way, seen from above or from the side, in true proportion.

    The disc around a player has half the collision radius: discs that overlap are a collision. In view is what
    surrounds the players at the frame, or the whole. The data must be named "frames", see `episode.frames`.
    """
    params = [alt.param(name=name, value=value) for name, value in {"frame": frame, "follow": follow, **whole}.items()]
    params += [alt.param(name=name, expr=expression) for name, expression in _window(up).items()]
    x = alt.X("x:Q", title="x [m]", scale=_scale("middle_x", "width"), axis=alt.Axis(grid=False, tickCount=6))
    y = alt.Y("y:Q", title=f"{up} [m]", scale=_scale("middle_y", "height"), axis=alt.Axis(grid=False, tickCount=4))
    who, order = alt.Color("player:N", legend=None), alt.Order("frame:Q")
    played, expected = (_paths(frames, f"{prefix}x", f"{prefix}{up}").encode(x, y) for prefix in ("", "label_"))
    now = played.transform_filter("datum.frame === frame")
    color = alt.expr(f"{STRUCK} ? danger : scale('color', datum.player)")
    size, opacity = alt.expr("PI * pow(metre * datum.radius / 2, 2)"), alt.expr(f"{STRUCK} ? 0.5 : 0.22")
    discs = now.mark_point(fill=color, stroke=color, size=size, fillOpacity=opacity, opacity=1, clip=True)
    trail = played.mark_line(strokeWidth=2.5, clip=True, strokeCap="round").transform_filter("datum.frame <= frame")
    return (
        alt.layer(
            expected.mark_line(strokeDash=[5, 4], strokeWidth=1.5, opacity=0.55, clip=True).encode(who, order),
            trail.encode(who, order),
            discs.transform_filter("datum.radius !== null"),
            now.mark_point(filled=True, size=30, opacity=1, clip=True).encode(who),
        )
        .properties(width=420, height=170)
        .add_params(*colors(), *params)
    )


def _scale(middle: str, side: str) -> alt.Scale:
    ends = [alt.expr(f"{middle} {sign} {side} / metre / 2") for sign in "-+"]
    return alt.Scale(domain=ends, nice=False, zero=False)


def _window(up: str) -> dict[str, str]:
    """Signals for the part of space in view: its middle, and the px of a metre."""
    now = "data('frames')[frame]"
    room = f"1.5 * ({now}.radius || 1)"
    near_x, near_y = (f"[extent({now}.{axis})[0] - {room}, extent({now}.{axis})[1] + {room}]" for axis in ("x", up))
    return {
        "shown_x": f"follow ? {near_x} : [left, right]",
        "shown_y": f"follow ? {near_y} : [bottom, top]",
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


def separation(frames: Any, frame: int = 0) -> Layers:
    """Distance between players over time, up to six times that below which it is a collision; one frame is marked."""
    far, radius = (f"extent(pluck(data('frames'), '{name}'))[1]" for name in ("distance", "radius"))
    reach = alt.param(name="reach", expr=f"isValid({radius}) ? min({far}, 6 * {radius}) : {far}")
    base = alt.Chart(frames).encode(x=alt.X("t:Q", title="t [s]", axis=alt.Axis(grid=False, tickCount=5)))
    scale = alt.Scale(domain=[0, alt.expr("reach")], nice=False)
    height = alt.Y("distance:Q", title="distance [m]", scale=scale, axis=alt.Axis(grid=False, tickCount=4))
    now = base.transform_filter("datum.frame === frame")
    dot = now.mark_circle(size=60, opacity=1, clip=True, color=alt.expr(f"{STRUCK} ? danger : ink"))
    return (
        alt.layer(
            base.mark_area(color=alt.expr("danger"), opacity=0.12).encode(y="radius:Q"),
            base.mark_line(color=alt.expr("danger"), strokeWidth=1.2).encode(y="radius:Q"),
            base.mark_line(color=alt.expr("ink"), strokeWidth=1.8, clip=True).encode(y=height),
            now.mark_rule(color=alt.expr("muted"), strokeDash=[3, 3]),
            dot.encode(y=height),
        )
        .properties(width="container", height=110)
        .add_params(*colors(), alt.param(name="frame", value=frame), reach)
    )
