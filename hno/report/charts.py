"""Charts, declared once with Altair for the page, which fills in data and moves signals, and for pictures."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any, Literal

import altair as alt

from hno.report import vega
from hno.report.strips import STRUCK, beliefs, heading, separation, strip
from hno.report.trials import over_trials
from hno.report.vega import Layers, colors

LEAST = 0.001
"""Lower end of the logarithmic colour scale of collision rates, everywhere; rates below have its first colour."""
LABEL = (
    "!datum.safe_starts ? 'n/a' : datum.shown === 0 ? '0' : datum.shown < 0.0005 ? '<0.1' : "
    "format(100 * datum.shown, datum.shown < 0.0995 ? '.1f' : '.0f')"
)
"""A rate in %, short enough for a cell; a collision is never rounded away."""
WHOLE = {"left": 0.0, "right": 10.0, "bottom": 0.0, "top": 10.0}
"""Signals of `encounter`: the part of space in which everything happens, m."""


def heat_map(data: Any, legend: alt.Legend | None = None) -> Layers:
    """Collision rates over the types of two players, in % in the cells, from rows of `recipes.by_type`.

    Its signals: "bound" is "rate", or "high" for the upper end of the rate's interval; "small" says whether cells have
    no room for a number.
    """
    axis = alt.Axis(labelAngle=0, ticks=False, domain=False, offset=2)
    base = (
        alt.Chart(data)
        .transform_calculate(theta_1="datum.theta[0]", theta_2="datum.theta[1]")
        .transform_calculate(shown="datum.safe_starts && bound === 'high' ? datum.interval[1] : datum.rate")
        .transform_calculate(label=LABEL)
        .encode(
            x=alt.X("theta_1:O", title="θ₁", axis=axis),
            y=alt.Y("theta_2:O", title="θ₂", axis=axis, sort="descending"),
            tooltip="tip:N",
        )
    )
    scale = alt.Scale(type="log", domain=[LEAST, 1], clamp=True, range="heatmap", interpolate="rgb")
    cell = base.mark_rect(cornerRadius=3, fill=alt.expr("zero"))
    some = cell.mark_rect(cornerRadius=3).encode(color=alt.Color("shown:Q", scale=scale, legend=legend))
    empty = cell.mark_rect(cornerRadius=3, fill="transparent", stroke=alt.expr("muted"), strokeDash=[2, 3])
    frame = cell.mark_rect(cornerRadius=3, fill=None, stroke=alt.expr("ink"), strokeWidth=2)
    contrast = "datum.shown > 0 ? (luminance(scale('color', datum.shown)) < 0.2 ? '#fff' : '#111') : muted"
    label = base.mark_text(fill=alt.expr(contrast), fontSize=alt.expr("small ? 8 : 11")).encode(text="label:N")
    return (
        alt.layer(
            cell.transform_filter("datum.shown === 0"),
            some.transform_filter("datum.shown > 0"),
            empty.transform_filter("datum.shown === null"),
            frame.transform_filter("datum.seen"),
            label.transform_filter("!small || !(datum.shown > 0)"),
        )
        .properties(width=alt.Step(34), height=alt.Step(34))
        .add_params(*colors(), alt.param(name="bound", value="rate"), alt.param(name="small", value=False))
    )


def comparison(data: Any) -> Layers:
    """Collision rates of recipes with their intervals, and of their seeds, from rows of `page_data.comparison`."""
    name = alt.Y("recipe:N", sort=None, title=None, axis=alt.Axis(labelLimit=260, ticks=False, domain=False))
    scale = alt.Scale(type="symlog", constant=LEAST / 4, domain=[0, 1], nice=False)
    axis = alt.Axis(values=[0, 0.001, 0.01, 0.1, 1], labelExpr="100 * datum.value + ' %'")
    rate = alt.X("rate:Q", scale=scale, axis=axis, title="collisions of safe starts")
    base = alt.Chart(data).encode(y=name, x=rate, tooltip="tip:N")
    pooled = base.transform_filter("datum.seed === null")
    band = pooled.mark_rule(strokeWidth=3, strokeCap="round", color=alt.expr("muted"), opacity=0.55)
    ring = base.mark_point(size=28, strokeWidth=1, opacity=0.8, color=alt.expr("muted"))
    dot = pooled.mark_circle(size=90, opacity=1, color=alt.expr("datum.rate > 0 ? danger : ink"))
    side = alt.expr("datum.rate > 0.1 ? 'right' : 'left'")
    return (
        alt.layer(
            band.encode(x=alt.X("low:Q", scale=scale), x2="high:Q"),
            ring.transform_filter("datum.seed !== null"),
            dot,
            pooled.mark_text(fontSize=9, dy=-9, align=side, fill=alt.expr("ink")).encode(text="count:N"),
        )
        .properties(width="container", height=alt.Step(26))
        .add_params(*colors())
    )


def clearances(data: Any) -> Layers:
    """Share of safe starts that keep no more than d, from rows with d, share, recipe and whether it is a "label".

    Its signal "near" is the name above the vertical axis.
    """
    scale = alt.Scale(type="symlog", constant=LEAST / 4, domain=[0, 1], nice=False)
    axis = alt.Axis(values=[0, 0.001, 0.01, 0.1, 1], labelExpr="100 * datum.value + ' %'")
    base = alt.Chart(data).encode(
        x=alt.X("d:Q", title="d", axis=alt.Axis(grid=False, tickCount=6), scale=alt.Scale(nice=False)),
        y=alt.Y("share:Q", title=None, scale=scale, axis=axis),
    )
    line = alt.Chart(data).mark_rule(color=alt.expr("danger"), strokeWidth=1.2).encode(x=alt.XDatum(0))
    name = alt.Color("recipe:N", sort=None, legend=alt.Legend(title=None, orient="bottom", columns=2, labelLimit=260))
    lines = base.mark_line(strokeWidth=1.6).encode(color=name).transform_filter("!datum.label")
    dashed = base.mark_line(strokeWidth=1.4, strokeDash=[5, 4], color=alt.expr("muted")).encode(detail="recipe:N")
    tips = base.mark_circle(size=50, opacity=0).encode(tooltip="tip:N")
    return (
        alt.layer(line, dashed.transform_filter("datum.label"), lines, tips)
        .properties(width="container", height=180, title=heading("near"))
        .add_params(*colors(), alt.param(name="near", value=""))
    )


def learning_curves(data: Any, scale: Literal["log", "linear"]) -> Layers:
    """A metric over training steps, one line for every run, from rows with step, value, run and recipe.

    Its signal "metric" is the name above the vertical axis, with a unit if it has one.
    """
    values = alt.Scale(type=scale, zero=False, nice=False)
    base = (
        alt.Chart(data)
        .transform_calculate(tip="datum.run + '\\nstep ' + datum.step + ': ' + datum.value")
        .encode(
            x=alt.X("step:Q", title="training step", axis=alt.Axis(grid=False, tickCount=5)),
            y=alt.Y("value:Q", title=None, scale=values, axis=alt.Axis(format="~g", tickCount=4, grid=False)),
            color=alt.Color("recipe:N", legend=alt.Legend(title=None, orient="bottom", columns=2, labelLimit=260)),
            detail="run:N",
        )
    )
    lines = base.mark_line(strokeWidth=1.4, opacity=0.75, interpolate="linear")
    points = base.mark_circle(size=60, opacity=0).encode(tooltip="tip:N")
    return (
        alt.layer(lines, points)
        .properties(width="container", height=200, title=heading("metric"))
        .add_params(*colors(), alt.param(name="metric", value=""))
    )


def encounter(
    frames: Any, up: Literal["y", "z"], frame: int = 0, follow: bool = True, whole: Mapping[str, float] = WHOLE
) -> Layers:
    """Players on their way, seen from above or from the side, in true proportion.

    The disc around a player has half the collision radius: discs that overlap are a collision. In view is what
    surrounds the players at the frame, or the whole. A diamond marks where another branch is played than before. The
    data must be named "frames", see `episode.frames`.
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
    another = "datum.frame > 0 && data('frames')[datum.frame - 1].branch !== datum.branch"
    changes = played.mark_point(shape="diamond", filled=True, size=90, opacity=1, clip=True)
    trail = played.mark_line(strokeWidth=2.5, clip=True, strokeCap="round").transform_filter("datum.frame <= frame")
    return (
        alt.layer(
            expected.mark_line(strokeDash=[5, 4], strokeWidth=1.5, opacity=0.55, clip=True).encode(who, order),
            trail.encode(who, order),
            changes.encode(who).transform_filter(f"datum.frame <= frame && {another}"),
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


@functools.cache
def specifications() -> dict[str, Any]:
    """Vega specifications of the page's charts, without data and colours."""
    cells, rows, points, frames = (alt.NamedData(name) for name in ("cells", "recipes", "points", "frames"))
    charts = {
        "heat": heat_map(cells), "comparison": comparison(rows), "log": learning_curves(points, "log"),
        "clearances": clearances(points),
        "linear": learning_curves(points, "linear"), "separation": separation(frames),
        "trials": over_trials(alt.NamedData("trials")), "beliefs": beliefs(frames),
        "strip": strip(alt.NamedData("series")),
    }  # fmt: skip
    return {name: vega.compiled(chart) for name, chart in charts.items()}
