"""Charts, declared once with Altair for the page, which fills in data and moves signals, and for pictures."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any, Literal

import altair as alt

from hno.report import vega
from hno.report.palette import LIGHT, signals

Layers = alt.LayerChart | alt.FacetChart
"""What Altair makes of charts on top of each other."""
RATES = (0.001, 1.0)
"""Ends of the logarithmic colour scale of collision rates, the same everywhere; rates below have the first colour."""
CELL = 34
"""Width of a heat map's cell, px."""
WHOLE = {"left": 0.0, "right": 10.0, "bottom": 0.0, "top": 10.0}
"""Signals of `encounter`: the part of space in which everything happens, m."""


def _colors() -> list[alt.Parameter]:
    return [alt.param(name=name, value=color) for name, color in signals(LIGHT).items()]


def _percent(value: str) -> str:
    return f"format(100 * {value}, '.2f') + ' %'"


LABEL = (
    "!datum.safe_starts ? 'n/a' : datum.shown === 0 ? '0' : datum.shown < 0.0005 ? '<0.1' : "
    "format(100 * datum.shown, datum.shown < 0.0995 ? '.1f' : '.0f')"
)
"""A rate in %, short enough for a cell; a collision is never rounded away."""
TIP = (
    "'types (' + join(datum.theta, ', ') + '), ' + (datum.seen ? 'seen in training' : 'without training labels')"
    "+ (datum.extrapolated ? '\\noutside the range that the game is made for: extrapolated' : '')"
    "+ (datum.safe_starts ? '\\n' + datum.collisions + ' of ' + datum.safe_starts + ' safe starts collide: ' + "
    f"{_percent('datum.rate')} + '\\n95 % interval ' + {_percent('datum.interval[0]')} + ' to ' + "
    f"{_percent('datum.interval[1]')} : '\\nno safe start: rate n/a')"
    "+ (datum.relative_excess === null ? '' : '\\nmedian excess cost ' + format(100 * datum.relative_excess, '+.1f') "
    "+ ' %')"
)


def heat_map(data: Any, cell: int = CELL, legend: alt.Legend | None = None, counts: bool = False) -> Layers:
    """Collision rates over the types of two players.

    Args:
        data: rows of `recipes.TypeCounts`.
        cell: width of a cell, px.
        legend: of the colours; none by default.
        counts: whether cells tell their numbers of starts too.

    Its signals: "bound" is "rate", or "high" for the upper end of the rate's interval; "small" says whether cells have
    no room for a number.
    """
    base = (
        alt.Chart(data)
        .transform_calculate(theta_1="datum.theta[0]", theta_2="datum.theta[1]")
        .transform_calculate(shown="datum.safe_starts && bound === 'high' ? datum.interval[1] : datum.rate")
        .transform_calculate(label=LABEL, tip=TIP, of="'of ' + datum.safe_starts")
        .encode(
            x=alt.X("theta_1:O", title="θ₁", axis=alt.Axis(labelAngle=0, ticks=False, domain=False, offset=2)),
            y=alt.Y("theta_2:O", sort="descending", title="θ₂", axis=alt.Axis(ticks=False, domain=False, offset=2)),
            tooltip="tip:N",
        )
    )
    scale = alt.Scale(type="log", domain=list(RATES), clamp=True, range="heatmap", interpolate="rgb")
    cells = base.mark_rect(cornerRadius=3, stroke=alt.expr("muted"), strokeWidth=alt.expr("0"))
    some = cells.transform_filter("datum.shown > 0").encode(color=alt.Color("shown:Q", scale=scale, legend=legend))
    none = cells.mark_rect(cornerRadius=3, fill=alt.expr("zero")).transform_filter("datum.shown === 0")
    nothing = base.mark_rect(cornerRadius=3, fill="transparent", stroke=alt.expr("muted"), strokeDash=[2, 3])
    seen = base.mark_rect(cornerRadius=3, fill=None, stroke=alt.expr("ink"), strokeWidth=2)
    contrast = "datum.shown > 0 ? (luminance(scale('color', datum.shown)) < 0.2 ? '#fff' : '#111') : muted"
    size = alt.expr("small ? 8 : 11")
    text = base.mark_text(fill=alt.expr(contrast), fontSize=size, dy=-6 if counts else 0)
    label = text.transform_filter("!small || !(datum.shown > 0)").encode(text="label:N")
    starts = [text.mark_text(fill=alt.expr(contrast), fontSize=9, dy=8).encode(text="of:N")] if counts else []
    layers = (none, some, nothing.transform_filter("datum.shown === null"), seen.transform_filter("datum.seen"), label)
    return (
        alt.layer(*layers, *starts)
        .properties(width=alt.Step(cell), height=alt.Step(cell))
        .add_params(*_colors(), alt.param(name="bound", value="rate"), alt.param(name="small", value=False))
    )


def comparison(data: Any) -> Layers:
    """Collision rates of recipes with their intervals, and of their seeds.

    Args:
        data: rows with recipe, rate, low, high, seed (null for the pooled rate), count (a text beside the pooled rate),
            tip; in the order to be shown.
    """
    base = alt.Chart(data).encode(
        y=alt.Y("recipe:N", sort=None, title=None, axis=alt.Axis(labelLimit=260, ticks=False, domain=False))
    )
    pooled = base.transform_filter("datum.seed === null")
    seeds = base.transform_filter("datum.seed !== null")
    band = pooled.mark_rule(strokeWidth=3, strokeCap="round", color=alt.expr("muted"), opacity=0.55)
    scale = alt.Scale(type="symlog", constant=RATES[0] / 4, domain=[0, 1], nice=False)
    axis = alt.Axis(values=[0, 0.001, 0.01, 0.1, 1], labelExpr="100 * datum.value + ' %'")
    rate = alt.X("rate:Q", scale=scale, axis=axis, title="collisions of safe starts")
    dot = pooled.mark_circle(size=90, opacity=1, color=alt.expr("datum.rate > 0 ? danger : ink"))
    count = pooled.mark_text(
        fontSize=9, dy=-9, align=alt.expr("datum.rate > 0.1 ? 'right' : 'left'"), fill=alt.expr("ink")
    )
    ring = seeds.mark_point(size=28, strokeWidth=1, opacity=0.8, color=alt.expr("muted"))
    return (
        alt.layer(
            band.encode(x=alt.X("low:Q", scale=scale), x2="high:Q", tooltip="tip:N"),
            ring.encode(x=rate, tooltip="tip:N"),
            dot.encode(x=rate, tooltip="tip:N"),
            count.encode(x=rate, text="count:N"),
        )
        .properties(width="container", height=alt.Step(26))
        .add_params(*_colors())
    )


def learning_curves(data: Any, scale: Literal["log", "linear"]) -> Layers:
    """A metric over training steps, one line for every run.

    Args:
        data: rows with step, value, run and recipe.
        scale: of the values.
    """
    tip = "datum.run + '\\nstep ' + datum.step + ': ' + datum.value"
    values = alt.Scale(type=scale, zero=False, nice=False)
    base = (
        alt.Chart(data)
        .transform_calculate(tip=tip)
        .encode(
            x=alt.X("step:Q", title="step", axis=alt.Axis(grid=False, tickCount=5)),
            y=alt.Y("value:Q", title=None, scale=values, axis=alt.Axis(format="~g", tickCount=4, grid=False)),
            color=alt.Color("recipe:N", legend=alt.Legend(title=None, orient="bottom", columns=2, labelLimit=260)),
            detail="run:N",
        )
    )
    lines = base.mark_line(strokeWidth=1.4, opacity=0.75, interpolate="linear")
    points = base.mark_circle(size=60, opacity=0).encode(tooltip="tip:N")
    return alt.layer(lines, points).properties(width="container", height=200)


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
        .add_params(*_colors(), *params)
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
        .add_params(*_colors(), alt.param(name="frame", value=frame), alt.param(name="reach", value=reach))
    )


@functools.cache
def specifications() -> dict[str, Any]:
    """Vega specifications of the page's charts, without data and colours."""
    cells, recipes, points, frames = (alt.NamedData(name) for name in ("cells", "recipes", "points", "frames"))
    return {
        "heat": vega.compiled(heat_map(cells)),
        "comparison": vega.compiled(comparison(recipes)),
        "log": vega.compiled(learning_curves(points, "log")),
        "linear": vega.compiled(learning_curves(points, "linear")),
        "top": vega.compiled(encounter(frames, "y")),
        "side": vega.compiled(encounter(frames, "z")),
        "separation": vega.compiled(separation(frames)),
    }
