"""Charts, declared with Altair: the page fills in data and moves signals, figures are drawn of them."""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from typing import Any, Literal

import altair as alt
import vl_convert

from hno.report.palette import LIGHT, signals

Layers = alt.LayerChart | alt.FacetChart
"""What Altair makes of charts on top of each other."""
RATES = (0.001, 1.0)
"""Ends of the logarithmic colour scale of collision rates, the same everywhere; rates below have the first colour."""
CELL = 34
"""Width of a heat map's cell, px."""


def _colors() -> list[alt.Parameter]:
    return [alt.param(name=name, value=color) for name, color in signals(LIGHT).items()]


def heat_map(data: Any, legend: alt.Legend | None = None, font: int | str = "bandwidth('x') < 26 ? 8 : 11") -> Layers:
    """Collision rates over the types of two players.

    Args:
        data: rows with theta_1, theta_2, shown (rate or one of its bounds, in [0, 1], or null), label, seen, tip.
        legend: of the colours; none by default.
        font: size of numbers in cells, px, or an expression; one with the scale "x" holds for single charts only.
    """
    base = alt.Chart(data).encode(
        x=alt.X("theta_1:O", title="θ₁", axis=alt.Axis(labelAngle=0, ticks=False, domain=False, offset=2)),
        y=alt.Y("theta_2:O", sort="descending", title="θ₂", axis=alt.Axis(ticks=False, domain=False, offset=2)),
        tooltip="tip:N",
    )
    scale = alt.Scale(type="log", domain=list(RATES), clamp=True, range="heatmap", interpolate="rgb")
    cells = base.mark_rect(cornerRadius=3, stroke=alt.expr("muted"), strokeWidth=alt.expr("0"))
    some = cells.transform_filter("datum.shown > 0").encode(color=alt.Color("shown:Q", scale=scale, legend=legend))
    none = cells.mark_rect(cornerRadius=3, fill=alt.expr("zero")).transform_filter("datum.shown === 0")
    nothing = base.mark_rect(cornerRadius=3, fill="transparent", stroke=alt.expr("muted"), strokeDash=[2, 3])
    seen = base.mark_rect(cornerRadius=3, fill=None, stroke=alt.expr("ink"), strokeWidth=2).transform_filter(
        "datum.seen"
    )
    contrast = "datum.shown > 0 ? (luminance(scale('color', datum.shown)) < 0.2 ? '#fff' : '#111') : muted"
    text = base.mark_text(fill=alt.expr(contrast), fontSize=font if isinstance(font, int) else alt.expr(font))
    return (
        alt.layer(none, some, nothing.transform_filter("datum.shown === null"), seen, text.encode(text="label:N"))
        .properties(width=alt.Step(CELL), height=alt.Step(CELL))
        .add_params(*_colors())
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
        data: rows with step, value, run, recipe, tip.
        scale: of the values, "log" or "linear".
    """
    base = alt.Chart(data).encode(
        x=alt.X("step:Q", title="step", axis=alt.Axis(grid=False, tickCount=5)),
        y=alt.Y(
            "value:Q",
            title=None,
            scale=alt.Scale(type=scale, zero=False, nice=False),
            axis=alt.Axis(format="~g", tickCount=4, grid=False),
        ),
        color=alt.Color("recipe:N", legend=alt.Legend(title=None, orient="bottom", columns=2, labelLimit=260)),
        detail="run:N",
    )
    lines = base.mark_line(strokeWidth=1.4, opacity=0.75, interpolate="linear")
    points = base.mark_circle(size=60, opacity=0).encode(tooltip="tip:N")
    return alt.layer(lines, points).properties(width="container", height=200)


def encounter(path: Any, ghost: Any, across: str, frame: int = 0, window: Mapping[str, float] | None = None) -> Layers:
    """Two players on their way, seen from above or from the side, in true proportion.

    The disc around a player has half the collision radius: discs that overlap are a collision.

    Args:
        path: rows with frame, player, x, y, radius (m), gap (distance minus collision radius, m).
        ghost: rows with frame, player, x, y along the equilibrium.
        across: name of the second axis, "y" or "z".
        frame: the one shown.
        window: "left", "right", "bottom" and "top" of the part of space that is shown, m; signals of the page.
    """
    view = {"frame": frame, "left": 0.0, "right": 10.0, "bottom": 0.0, "top": 10.0, **(window or {})}
    sides = [
        alt.Scale(domain=[alt.expr(lo), alt.expr(hi)], nice=False, zero=False)
        for lo, hi in (("left", "right"), ("bottom", "top"))
    ]
    along = alt.X("x:Q", title="x [m]", scale=sides[0], axis=alt.Axis(grid=False, tickCount=6))
    up = alt.Y("y:Q", title=f"{across} [m]", scale=sides[1], axis=alt.Axis(grid=False, tickCount=4))
    who = alt.Color("player:N", legend=None)
    order = alt.Order("frame:Q")
    gone = alt.Chart(path).encode(along, up, who)
    now = gone.transform_filter("datum.frame === frame")
    size = "PI * pow(scale('x', datum.x + datum.radius / 2) - scale('x', datum.x), 2)"
    expected = alt.Chart(ghost).mark_line(strokeDash=[5, 4], strokeWidth=1.5, opacity=0.55, clip=True)
    trail = gone.mark_line(strokeWidth=2.5, clip=True, strokeCap="round").transform_filter("datum.frame <= frame")
    own, danger = alt.expr("scale('color', datum.player)"), alt.expr("danger")
    safe, struck = now.transform_filter("datum.gap >= 0"), now.transform_filter("datum.gap < 0")
    at = now.mark_point(filled=True, size=30, opacity=1, clip=True)
    return (
        alt.layer(
            expected.encode(along, up, who, order),
            trail.encode(order),
            safe.mark_point(filled=True, stroke=own, size=alt.expr(size), fillOpacity=0.22, opacity=1, clip=True),
            struck.mark_point(fill=danger, stroke=danger, size=alt.expr(size), fillOpacity=0.5, opacity=1, clip=True)
            .encode(color=alt.Undefined),
            at,
        )
        .properties(width=400, height=200)
        .add_params(*_colors(), *(alt.param(name=name, value=value) for name, value in view.items()))
    )  # fmt: skip


def separation(data: Any, frame: int = 0) -> Layers:
    """Distance between players over time, with the distance below which it is a collision.

    Args:
        data: rows with frame, t (s), distance and radius (m).
        frame: the one marked.

    Its signal "reach" is the largest distance shown, m.
    """
    base = alt.Chart(data).encode(x=alt.X("t:Q", title="t [s]", axis=alt.Axis(grid=False, tickCount=5)))
    scale = alt.Scale(domain=[0, alt.expr("reach")], nice=False)
    height = alt.Y("distance:Q", title="distance [m]", scale=scale, axis=alt.Axis(grid=False, tickCount=4))
    forbidden = base.mark_area(color=alt.expr("danger"), opacity=0.12).encode(y="radius:Q")
    edge = base.mark_line(color=alt.expr("danger"), strokeWidth=1.2).encode(y="radius:Q")
    line = base.mark_line(color=alt.expr("ink"), strokeWidth=1.8, clip=True).encode(y=height)
    now = base.transform_filter("datum.frame === frame")
    cursor = now.mark_rule(color=alt.expr("muted"), strokeDash=[3, 3])
    dot = now.mark_circle(
        size=60, opacity=1, clip=True, color=alt.expr("datum.distance < datum.radius ? danger : ink")
    ).encode(y=height)
    return (
        alt.layer(forbidden, edge, line, cursor, dot)
        .properties(width="container", height=110)
        .add_params(*_colors(), alt.param(name="frame", value=frame), alt.param(name="reach", value=10))
    )


@functools.cache
def specifications() -> dict[str, Any]:
    """Vega specifications of the page's charts, without data and colours."""
    named = alt.NamedData
    return {
        "heat": compiled(heat_map(named("cells"))),
        "comparison": compiled(comparison(named("recipes"))),
        "log": compiled(learning_curves(named("points"), "log")),
        "linear": compiled(learning_curves(named("points"), "linear")),
        "top": compiled(encounter(named("path"), named("ghost"), "y")),
        "side": compiled(encounter(named("path"), named("ghost"), "z")),
        "separation": compiled(separation(named("distances"))),
    }


def compiled(chart: alt.TopLevelMixin) -> dict[str, Any]:
    """A chart as Vega, without a configuration of its own."""
    specification = chart.to_dict()
    specification.pop("config", None)
    vega = vl_convert.vegalite_to_vega(specification, vl_version=version())
    for name in ("config", "background", "$schema"):
        vega.pop(name, None)
    return json.loads(json.dumps(vega))


def version() -> str:
    """The version of Vega-Lite that Altair writes."""
    return ".".join(alt.SCHEMA_VERSION.removeprefix("v").split(".")[:2])


@functools.cache
def library() -> str:
    """Vega-Embed, with Vega inside, as one script that defines `window.vegaEmbed`."""
    return vl_convert.javascript_bundle("window.vegaEmbed = vegaEmbed;", vl_version=version())
