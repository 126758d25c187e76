"""Colours of pages and figures, for light and for dark surroundings."""

from __future__ import annotations

from typing import Any, NamedTuple

FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', 'Liberation Sans', Arial, sans-serif"


class Palette(NamedTuple):
    """One set of colours; text reaches a contrast of 4.5 on its ground."""

    paper: str
    surface: str
    ink: str
    muted: str
    line: str
    accent: str
    good: str
    danger: str
    zero: str
    """Cells of heat maps without any collision, apart from the scale of those with some."""
    category: tuple[str, ...]
    """Players and recipes, told apart by people with colour blindness too."""
    rates: tuple[float, float]
    """Part of the perceptually uniform scale "inferno" for rates above zero, rare to frequent."""


LIGHT = Palette(
    paper="#f7f8f9", surface="#ffffff", ink="#1b2430", muted="#586473", line="#e1e5ea", accent="#1f5fa8",
    good="#1d7a5f", danger="#c22f2f", zero="#e2efe9",
    category=("#2b6cb0", "#d08700", "#2a9076", "#a5539a", "#6b7785", "#4ba3d3", "#8c6239", "#b8474b"),
    rates=(0.88, 0.18),
)  # fmt: skip
DARK = Palette(
    paper="#12161c", surface="#1a2028", ink="#e6eaef", muted="#9aa6b4", line="#2e3742", accent="#7db4f0",
    good="#63c7a5", danger="#ff6f61", zero="#21362f",
    category=("#6aa9ea", "#f0b429", "#5cc4a4", "#d38ac9", "#9aa6b4", "#86cdf0", "#c79a6b", "#ec8a86"),
    rates=(0.32, 0.95),
)  # fmt: skip


def chart_config(palette: Palette) -> dict[str, Any]:
    """Configuration of Vega for a palette."""
    axis = {
        "domainColor": palette.line, "gridColor": palette.line, "tickColor": palette.line, "labelColor": palette.muted,
        "titleColor": palette.muted, "labelFont": FONT, "titleFont": FONT, "labelFontSize": 11, "titleFontSize": 11,
        "titleFontWeight": "normal", "gridOpacity": 0.7, "tickSize": 4, "labelPadding": 4,
    }  # fmt: skip
    legend = {name: axis[name] for name in ("labelColor", "titleColor", "labelFont", "titleFont", "titleFontWeight")}
    return {
        "background": "transparent",
        "axis": axis,
        "legend": {**legend, "labelFontSize": 11, "titleFontSize": 11, "symbolType": "circle"},
        "title": {
            "color": palette.ink,
            "subtitleColor": palette.muted,
            "font": FONT,
            "fontSize": 12,
            "fontWeight": 600,
        },
        "header": {"labelColor": palette.ink, "titleColor": palette.muted, "labelFont": FONT, "titleFont": FONT},
        "text": {"font": FONT, "fontSize": 11},
        "range": {"category": list(palette.category), "heatmap": {"scheme": "inferno", "extent": list(palette.rates)}},
        "style": {"cell": {"stroke": "transparent"}, "guide-label": {"font": FONT}, "guide-title": {"font": FONT}},
    }


def signals(palette: Palette) -> dict[str, str]:
    """Colours that charts ask for by name."""
    return {"ink": palette.ink, "muted": palette.muted, "danger": palette.danger, "zero": palette.zero}


INFERNO = (
    "#000004", "#160b39", "#420a68", "#6a176e", "#932667", "#bc3754", "#dd513a", "#f37819", "#fca50a", "#f6d746",
    "#fcffa4",
)  # fmt: skip
"""The scale of heat maps in steps of a tenth, for the page's legend."""


def variables(palette: Palette) -> str:
    """Custom properties of the page's style."""
    names = {name: value for name, value in palette._asdict().items() if isinstance(value, str)}
    start, end = (round(10 * share) for share in palette.rates)
    stops = INFERNO[start : end + 1] if start < end else INFERNO[end : start + 1][::-1]
    pairs = {**names, "rates": f"linear-gradient(to right,{','.join(stops)})", "font": FONT}
    return "".join(f"--{name}:{value};" for name, value in pairs.items())
