"""Charts, declared once with Altair for the page, which fills in data and moves signals, and for pictures."""

from __future__ import annotations

import functools
from typing import Any, Literal

import altair as alt

from hno.report import vega
from hno.report.episode_charts import encounter, separation
from hno.report.vega import Layers, colors

RATES = (0.001, 1.0)
"""Ends of the logarithmic colour scale of collision rates, the same everywhere; rates below have the first colour."""
CELL = 34
"""Width of a heat map's cell, px."""


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
        .add_params(*colors(), alt.param(name="bound", value="rate"), alt.param(name="small", value=False))
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
        .add_params(*colors())
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
