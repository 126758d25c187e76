"""The page's landscapes: the chart that draws one, and where those of runs lie."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from urllib.parse import quote

from hno.report.records import Run
from hno.report.tables import Row, names_of

SIGNALS = {
    "low": -10, "high": 0, "scheme": "viridis", "levels": [], "columns": 2, "rows": 2, "x_title": "", "y_title": "",
    "x_ends": [0, 1], "y_ends": [0, 1], "ink": "#000", "muted": "#000", "danger": "#f00", "title": "", "arrow": "#fff",
    "level": [], "coarse_points": 2, "type_ends": [0, 1],
}  # fmt: skip
"""What the page says of a chart beside its data, and colours."""
PIXEL = "[width / ({} - 1), height / ({} - 1)]"
"""Distance between two points of a grid."""


def entries(runs: Iterable[Run], place: Path | None) -> list[Row]:
    """The runs that have a landscape, and the address of its file relative to the page's folder, if that is known."""
    return [{**names_of(run), "run": run.name, "src": _address(run.landscape, place)} for run in runs if run.landscape]


def _address(path: Path, place: Path | None) -> str:
    if place is None:
        return path.resolve().as_uri()
    return quote(Path(os.path.relpath(path.resolve(), place.resolve())).as_posix())


def chart() -> dict[str, Any]:
    """A heat map with level sets, the boundary of the violation set and arrows, as Vega.

    Its data: "grid", "shape" and "barrier" are one raster each, {width, height, values} from the top left: the values,
    the same without NaN, and the constraint; "arrows" have ends x, y, x2, y2 in coordinates and an angle, degrees;
    "family" has a raster for every one of several types.
    """
    return {
        "padding": 4,
        "signals": _signals(),
        "data": _data(),
        "scales": [
            {"name": "x", "type": "linear", "domain": {"signal": "x_ends"}, "range": "width", "zero": False},
            {"name": "y", "type": "linear", "domain": {"signal": "y_ends"}, "range": "height", "zero": False},
            {"name": "color", "type": "symlog", "domain": [{"signal": "low"}, {"signal": "high"}],
             "range": {"scheme": {"signal": "scheme"}}},
            {"name": "types", "type": "linear", "domain": {"signal": "type_ends"}, "zero": False,
             "range": {"scheme": "plasma", "extent": [0.1, 0.9]}},
        ],
        "axes": [
            {"scale": "x", "orient": "bottom", "title": {"signal": "x_title"}, "tickCount": 6},
            {"scale": "y", "orient": "left", "title": {"signal": "y_title"}, "tickCount": 6},
        ],
        "legends": [{"fill": "color", "type": "gradient", "title": {"signal": "title"}, "format": ",.5~g",
                     "gradientLength": {"signal": "height - 30"}, "values": {"signal": "levels"}}],
        "marks": [{
            "type": "group", "clip": True,
            "encode": {"update": {"width": {"signal": "width"}, "height": {"signal": "height"}}},
            "marks": [
                _image(), _lines("contours", {"signal": "ink"}, 0.8, 0.45),
                _lines("boundary", {"signal": "danger"}, 2.5, 1), *_arrows(),
                _lines("sets", {"scale": "types", "field": "theta"}, 2.2, 1),
            ],
        }],
    }  # fmt: skip


def _signals() -> list[dict[str, Any]]:
    return [
        {"name": "width", "value": 300}, {"name": "height", "value": 260},
        *({"name": name, "value": value} for name, value in SIGNALS.items()),
        {"name": "pixel", "update": PIXEL.format("columns", "rows")},
        {"name": "pointer", "on": [
            {"events": "pointermove", "update": "[invert('x', x()), invert('y', y())]"}]},
        {"name": "coarse", "update": PIXEL.format("coarse_points", "coarse_points")},
    ]  # fmt: skip


def _data() -> list[dict[str, Any]]:
    return [
        {"name": "grid", "values": []},
        {"name": "raster", "source": "grid", "transform": [
            {"type": "heatmap", "color": {"expr": "scale('color', datum.$value)"},
             "opacity": {"expr": "isValid(datum.$value) && isFinite(datum.$value) ? 1 : 0"}}]},
        {"name": "shape", "values": []},
        {"name": "contours", "source": "shape", "transform": [_contour({"signal": "levels"})]},
        {"name": "barrier", "values": []},
        {"name": "boundary", "source": "barrier", "transform": [_contour([0])]},
        {"name": "arrows", "values": []},
        {"name": "family", "values": []},
        {"name": "sets", "source": "family", "transform": [
            {**_contour({"signal": "level"}, "coarse"), "field": "raster"}]},
    ]  # fmt: skip


def _contour(levels: Any, pixel: str = "pixel") -> dict[str, Any]:
    place = {"scale": {"signal": pixel}, "translate": {"signal": f"[-{pixel}[0] / 2, -{pixel}[1] / 2]"}}
    return {"type": "isocontour", "thresholds": levels, "zero": False, **place}


def _image() -> dict[str, Any]:
    """The raster, whose outer points lie on the edges."""
    update = {
        "x": {"signal": "-pixel[0] / 2"}, "y": {"signal": "-pixel[1] / 2"}, "image": {"field": "image"},
        "width": {"signal": "width + pixel[0]"}, "height": {"signal": "height + pixel[1]"}, "aspect": {"value": False},
        "smooth": {"value": True},
    }  # fmt: skip
    return {"type": "image", "from": {"data": "raster"}, "encode": {"update": update}}


def _lines(data: str, stroke: dict[str, str], width: float, opacity: float) -> dict[str, Any]:
    update = {"stroke": stroke, "strokeWidth": {"value": width}, "strokeOpacity": {"value": opacity}}
    transform = [{"type": "geopath", "field": "datum.contour"}]
    return {"type": "path", "from": {"data": data}, "encode": {"update": update}, "transform": transform}


def _arrows() -> list[dict[str, Any]]:
    ends = {
        "x": {"scale": "x", "field": "x"}, "y": {"scale": "y", "field": "y"},
        "x2": {"scale": "x", "field": "x2"}, "y2": {"scale": "y", "field": "y2"},
    }  # fmt: skip
    shaft = {"stroke": {"signal": "arrow"}, "strokeWidth": {"value": 1.4}, "strokeOpacity": {"value": 0.9}}
    head = {
        "x": ends["x2"], "y": ends["y2"], "shape": {"value": "triangle"}, "size": {"value": 22},
        "angle": {"field": "angle"}, "fill": {"signal": "arrow"}, "fillOpacity": {"value": 0.95},
    }  # fmt: skip
    return [
        {"type": "rule", "from": {"data": "arrows"}, "encode": {"update": {**ends, **shaft}}},
        {"type": "symbol", "from": {"data": "arrows"}, "encode": {"update": head}},
    ]
