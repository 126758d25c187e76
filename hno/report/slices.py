"""A slice as a picture."""

from __future__ import annotations

import io
from typing import Any

import altair as alt
import numpy as np

from hno.control.slices import Slice
from hno.evaluation.format import at
from hno.report import vega


def picture(found: Slice) -> Any:
    """W, or V_1, over a plane as a PIL image; states in the violation set are framed."""
    from PIL import Image

    return Image.open(io.BytesIO(vega.png(chart(found)))).convert("RGB")


def chart(found: Slice) -> alt.Chart:
    """The same as a chart, with a colour scale that is logarithmic in the distance from 0."""
    value, name = (found.value[..., 0], "V₁") if found.potential is None else (found.potential, "W")
    sides = {"x": found.across, "y": found.up}
    half = {axis: (side.values[1] - side.values[0]) / 2 for axis, side in sides.items()}
    rows = [
        {
            "x": float(x - half["x"]), "x2": float(x + half["x"]), "y": float(y - half["y"]),
            "y2": float(y + half["y"]), "value": float(value[k, j]), "inside": bool(found.violation[k, j] >= 0),
        }
        for k, y in enumerate(found.up.values)
        for j, x in enumerate(found.across.values)
        if np.isfinite(value[k, j])
    ]  # fmt: skip
    tight = alt.Scale(zero=False, nice=False)
    return (
        alt.Chart(vega.inline(rows))
        .mark_rect()
        .encode(
            x=alt.X("x:Q", title=found.across.label, scale=tight),
            x2="x2",
            y=alt.Y("y:Q", title=found.up.label, scale=tight),
            y2="y2",
            color=alt.Color("value:Q", title=name, scale=alt.Scale(type="symlog", scheme="viridis")),
            stroke=alt.condition("datum.inside", alt.value("#c22f2f"), alt.value(None)),
        )
        .properties(width=320, height=240, title=f"{name}, {found.tau:g} s to go, types {at(found.theta)}")
    )
