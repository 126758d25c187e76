"""Colours of pages and figures, for light and for dark surroundings; text reaches a contrast of 4.5 on its ground."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', 'Liberation Sans', Arial, sans-serif"
Palette = Mapping[str, str]
"""Colours by name; "zero" is for cells of heat maps without any collision, apart from the scale of those with some."""

LIGHT: Palette = {
    "paper": "#f7f8f9", "surface": "#ffffff", "ink": "#1b2430", "muted": "#586473", "line": "#e1e5ea",
    "accent": "#1f5fa8", "good": "#1d7a5f", "danger": "#c22f2f", "zero": "#e2efe9",
}  # fmt: skip
DARK: Palette = {
    "paper": "#12161c", "surface": "#1a2028", "ink": "#e6eaef", "muted": "#9aa6b4", "line": "#2e3742",
    "accent": "#7db4f0", "good": "#63c7a5", "danger": "#ff6f61", "zero": "#21362f",
}  # fmt: skip
CATEGORY = {
    "light": ("#2b6cb0", "#d08700", "#2a9076", "#a5539a", "#6b7785", "#4ba3d3", "#8c6239", "#b8474b"),
    "dark": ("#6aa9ea", "#f0b429", "#5cc4a4", "#d38ac9", "#9aa6b4", "#86cdf0", "#c79a6b", "#ec8a86"),
}
"""Players and recipes, told apart by people with colour blindness too."""
RATES = {"light": (0.88, 0.18), "dark": (0.32, 0.95)}
"""Part of the perceptually uniform scale "inferno" for rates above zero, rare to frequent; page.css repeats it."""


def chart_config(theme: str) -> dict[str, Any]:
    """Configuration of Vega for a theme, "light" or "dark"."""
    colors = {"light": LIGHT, "dark": DARK}[theme]
    text = {"font": FONT, "fontSize": 11, "fill": colors["muted"]}
    lines = dict.fromkeys(("domainColor", "gridColor", "tickColor"), colors["line"])
    return {
        "background": "transparent",
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


def signals(colors: Palette) -> dict[str, str]:
    """Colours that charts ask for by name."""
    return {name: colors[name] for name in ("ink", "muted", "danger", "zero")}
