"""Charts of Altair as Vega for the page, and as SVG and PNG without a browser."""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping, Sequence
from typing import Any

import altair as alt
import vl_convert

from hno.report.palette import LIGHT, chart_config, signals

Layers = alt.LayerChart | alt.FacetChart
"""What Altair makes of charts on top of each other."""


def colors() -> list[alt.Parameter]:
    """Colours that a chart asks for by name; the page replaces them in the dark."""
    return [alt.param(name=name, value=color) for name, color in signals(LIGHT).items()]


def compiled(chart: alt.TopLevelMixin) -> dict[str, Any]:
    """A chart as Vega, without a configuration of its own."""
    specification = chart.to_dict()
    specification.pop("config", None)
    vega = vl_convert.vegalite_to_vega(specification, vl_version=version())
    for name in ("config", "background", "$schema"):
        vega.pop(name, None)
    return json.loads(json.dumps(vega))


def svg(chart: alt.TopLevelMixin) -> str:
    """A chart with data as SVG, in light colours."""
    specification = chart.to_dict()
    specification["config"] = {**chart_config("light"), "background": "white", "aria": False}
    return vl_convert.vegalite_to_svg(specification, vl_version=version())


def png(chart: alt.TopLevelMixin) -> bytes:
    """The same as PNG."""
    return vl_convert.svg_to_png(svg(chart), scale=2)


def inline(rows: Sequence[Mapping[str, Any]], name: str = "rows") -> alt.InlineData:
    """Data that a chart carries with it."""
    return alt.InlineData(values=list(rows), name=name)


def version() -> str:
    """The version of Vega-Lite that Altair writes."""
    return ".".join(alt.SCHEMA_VERSION.removeprefix("v").split(".")[:2])


@functools.cache
def library() -> str:
    """Vega-Embed, with Vega inside, as one script that defines `window.vegaEmbed`."""
    return vl_convert.javascript_bundle("window.vegaEmbed = vegaEmbed;", vl_version=version())
