"""Charts of Altair as Vega for the page, and as SVG and PNG without a browser; the colours of pages and figures."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import altair as alt
import vl_convert

Layers = alt.LayerChart | alt.FacetChart
"""What Altair makes of charts on top of each other."""
VERSION = ".".join(alt.SCHEMA_VERSION.removeprefix("v").split(".")[:2])
"""Of Vega-Lite, as Altair writes it."""
FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', 'Liberation Sans', Arial, sans-serif"
Palette = Mapping[str, str]
"""Colours by name; "zero" is for cells of heat maps without any collision, apart from the scale of those with some."""

THEMES: Mapping[str, Palette] = {
    "light": {
        "paper": "#f7f8f9", "surface": "#ffffff", "ink": "#1b2430", "muted": "#586473", "line": "#e1e5ea",
        "accent": "#1f5fa8", "good": "#1d7a5f", "danger": "#c22f2f", "zero": "#e2efe9",
    },
    "dark": {
        "paper": "#12161c", "surface": "#1a2028", "ink": "#e6eaef", "muted": "#9aa6b4", "line": "#2e3742",
        "accent": "#7db4f0", "good": "#63c7a5", "danger": "#ff6f61", "zero": "#21362f",
    },
}  # fmt: skip
"""For light and for dark surroundings; text reaches a contrast of 4.5 on its ground."""
CATEGORY = {
    "light": ("#2b6cb0", "#d08700", "#2a9076", "#a5539a", "#6b7785", "#4ba3d3", "#8c6239", "#b8474b"),
    "dark": ("#6aa9ea", "#f0b429", "#5cc4a4", "#d38ac9", "#9aa6b4", "#86cdf0", "#c79a6b", "#ec8a86"),
}
"""Players and recipes, told apart by people with colour blindness too."""
RATES = {"light": (0.88, 0.18), "dark": (0.32, 0.95)}
"""Part of the perceptually uniform scale "inferno" for rates above zero, rare to frequent; page.css repeats it."""


def chart_config(theme: str) -> dict[str, Any]:
    """Configuration of Vega for a theme, "light" or "dark"."""
    colors = THEMES[theme]
    text = {"font": FONT, "fontSize": 11, "fill": colors["muted"]}
    lines = dict.fromkeys(("domainColor", "gridColor", "tickColor"), colors["line"])
    return {
        "background": "transparent",
        "aria": False,  # a chart has one name, that of its place in the page
        "axis": {**lines, "gridOpacity": 0.7, "tickSize": 4, "labelPadding": 4},
        "legend": {"symbolType": "circle"},
        "text": {"font": FONT, "fontSize": 11},
        "range": {"category": CATEGORY[theme], "heatmap": {"scheme": "inferno", "extent": RATES[theme]}},
        "style": {
            "cell": {"stroke": "transparent"},
            "guide-label": text,
            "guide-title": {**text, "fontWeight": "normal"},
            "group-title": {"font": FONT, "fontSize": 12, "fontWeight": 600, "fill": colors["ink"]},
            "group-subtitle": text,
        },
    }


def signals(theme: str) -> dict[str, str]:
    """Colours of a theme that charts ask for by name."""
    return {name: THEMES[theme][name] for name in ("ink", "muted", "danger", "zero")}


def colors() -> list[alt.Parameter]:
    """These as a chart's parameters; the page replaces them in the dark."""
    return [alt.param(name=name, value=color) for name, color in signals("light").items()]


def compiled(chart: alt.TopLevelMixin) -> dict[str, Any]:
    """A chart as Vega, without a configuration of its own and without names for its marks, which nobody could read."""
    vega = vl_convert.vegalite_to_vega({**chart.to_dict(), "config": {}}, vl_version=VERSION)
    for mark in _marks(vega):
        mark["aria"] = False
    return {name: entry for name, entry in vega.items() if name not in ("config", "background", "$schema")}


def _marks(entry: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for mark in entry.get("marks", ()):
        yield mark
        yield from _marks(mark)


def svg(chart: alt.TopLevelMixin) -> str:
    """A chart with data as SVG, in light colours."""
    config = {**chart_config("light"), "background": "white"}
    return vl_convert.vegalite_to_svg({**chart.to_dict(), "config": config}, vl_version=VERSION)


def png(chart: alt.TopLevelMixin) -> bytes:
    """The same as PNG."""
    return vl_convert.svg_to_png(svg(chart), scale=2)


def inline(rows: Sequence[Mapping[str, Any]], name: str = "rows") -> alt.InlineData:
    """Data that a chart carries with it."""
    return alt.InlineData(values=list(rows), name=name)


@functools.cache
def library() -> str:
    """Vega-Embed, with Vega inside, as one script that defines `window.vegaEmbed`."""
    return vl_convert.javascript_bundle("window.vegaEmbed = vegaEmbed;", vl_version=VERSION)
