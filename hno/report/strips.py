"""Numbers of an episode over time, as charts."""

from __future__ import annotations

from typing import Any

import altair as alt

from hno.report.vega import Layers, colors

STRUCK = "datum.radius !== null && datum.distance < datum.radius"
"""Whether a frame is a collision."""


def heading(signal: str) -> alt.TitleParams:
    """What a signal says, above the vertical axis."""
    return alt.TitleParams(alt.expr(signal), anchor="start", fontSize=11, fontWeight="normal", color=alt.expr("muted"))


def separation(frames: Any, frame: int | None = None) -> Layers:
    """Distance between players over time, up to six times that below which it is a collision; a frame may be marked."""
    far, radius = (f"extent(pluck(data('frames'), '{name}'))[1]" for name in ("distance", "radius"))
    reach = alt.param(name="reach", expr=f"isValid({radius}) ? min({far}, 6 * {radius}) : {far}")
    base = alt.Chart(frames).encode(x=alt.X("t:Q", title="t [s]", axis=alt.Axis(grid=False, tickCount=5)))
    scale = alt.Scale(domain=[0, alt.expr("reach")], nice=False)
    height = alt.Y("distance:Q", title="distance [m]", scale=scale, axis=alt.Axis(grid=False, tickCount=4))
    now = base.transform_filter("datum.frame === frame")
    dot = now.mark_circle(size=60, opacity=1, clip=True, color=alt.expr(f"{STRUCK} ? danger : ink"))
    layers = [
        base.mark_area(color=alt.expr("danger"), opacity=0.12).encode(y="radius:Q"),
        base.mark_line(color=alt.expr("danger"), strokeWidth=1.2).encode(y="radius:Q"),
        base.mark_line(color=alt.expr("ink"), strokeWidth=1.8, clip=True).encode(y=height),
    ]
    if frame is not None:
        layers += [now.mark_rule(color=alt.expr("muted"), strokeDash=[3, 3]), dot.encode(y=height)]
    marked = [] if frame is None else [alt.param(name="frame", value=frame)]
    return alt.layer(*layers).properties(width="container", height=110).add_params(*colors(), *marked, reach)


def beliefs(frames: Any) -> Layers:
    """What is believed of every type over time: mean and 90 %, beside the type, dashed."""
    base = (
        alt.Chart(frames)
        .transform_filter("isValid(datum.mean)")
        .transform_calculate(player="sequence(1, length(datum.mean) + 1)")
        .transform_flatten(["player", "mean", "low", "high", "type"])
        .encode(
            x=alt.X("t:Q", title="t [s]", axis=alt.Axis(grid=False, tickCount=5)),
            color=alt.Color("player:N", legend=None),
        )
    )
    height = alt.Y("mean:Q", title="believed type", scale=alt.Scale(zero=False), axis=alt.Axis(grid=False, tickCount=4))
    return (
        alt.layer(
            base.mark_area(opacity=0.15).encode(y=alt.Y("low:Q", title="believed type"), y2="high:Q"),
            base.mark_line(strokeDash=[5, 4], strokeWidth=1.5, opacity=0.7).encode(y="type:Q"),
            base.mark_line(strokeWidth=1.8).encode(y=height),
        )
        .properties(width="container", height=110)
        .add_params(*colors())
    )


def strip(data: Any) -> Layers:
    """A number of every player over time, from rows with t, player, y and "beside", whether it is another policy's.

    Its signal "heading" is what it is, with a unit.
    """
    values = alt.Scale(zero=False, nice=True)
    lines = (
        alt.Chart(data)
        .mark_line(strokeWidth=1.6, interpolate="linear")
        .encode(
            x=alt.X("t:Q", title="t [s]", axis=alt.Axis(grid=False, tickCount=5)),
            y=alt.Y("y:Q", title=None, scale=values, axis=alt.Axis(grid=False, tickCount=3)),
            color=alt.Color("player:N", legend=None),
            strokeDash=alt.StrokeDash(
                "beside:N", legend=None, scale=alt.Scale(domain=[False, True], range=[[], [3, 2]])
            ),
        )
    )
    return (
        alt.layer(lines)
        .properties(width="container", height=90, title=heading("heading"))
        .add_params(*colors(), alt.param(name="heading", value=""))
    )
