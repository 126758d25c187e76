"""Numbers, types and paths as people read them; the same in the terminal, on pages and for dashboards."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

NOT_AVAILABLE = "n/a"
"""What stands for a number that does not exist."""
NAMES = ("game", "operator", "function", "activation")
"""Entries of results.json that name what was trained."""


def title(results: Mapping[str, Any]) -> str:
    """What was trained, on one line; what results do not name is left out."""
    return " / ".join(str(results[name]) for name in NAMES if name in results)


def number(value: float | None, digits: int = 2) -> str:
    """A number with a few decimals; a zero has no sign."""
    return NOT_AVAILABLE if value is None else f"{value:z,.{digits}f}"


def numbers(values: Iterable[float] | None) -> str:
    """Several numbers."""
    return NOT_AVAILABLE if values is None else ", ".join(map(number, values))


def cost(found: tuple[float | None, float | None]) -> str:
    """A cost above the equilibrium's, and the equilibrium's."""
    above, equilibrium = found
    return f"{number(above)} of {number(equilibrium)}"


def significant(value: float | None, digits: int = 3) -> str:
    """A number with a few significant digits."""
    return NOT_AVAILABLE if value is None else f"{value:z.{digits}g}"


def percent(value: float | None, digits: int = 2) -> str:
    """A share in per cent; one that would be rounded to 0 is "< 0.01 %"."""
    if value is None:
        return NOT_AVAILABLE
    least = 10.0**-digits
    if 0 < 100 * abs(value) < least / 2:
        return f"{'<' if value > 0 else '> -'} {least:.{digits}f} %".replace("- ", "-")
    return f"{100 * value:z.{digits}f} %"


def signed(value: float | None, digits: int = 1) -> str:
    """A relative difference in per cent, with its sign unless it is rounded to 0."""
    if value is None:
        return NOT_AVAILABLE
    text = f"{100 * value:+z,.{digits}f}"
    return f"{text if float(text.replace(',', '')) else text[1:]} %"


def interval(bounds: Sequence[float] | None) -> str:
    """Both bounds of a share in per cent."""
    return NOT_AVAILABLE if bounds is None else f"{100 * bounds[0]:z.2f} to {100 * bounds[1]:z.2f} %"


def whole(value: int | None) -> str:
    """A count."""
    return NOT_AVAILABLE if value is None else f"{value:,}"


def types(theta: Iterable[float] | None) -> str:
    """Player types; "all" for all of them together."""
    return "all" if theta is None else ", ".join(f"{entry:g}" for entry in theta)


def at(theta: Iterable[float]) -> str:
    """Where something was: player types."""
    return f"({types(theta)})"


def counted(count: int, noun: str) -> str:
    """A number of things."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def short_names(paths: Sequence[str]) -> list[str]:
    """Paths without the folders that all have in common."""
    whole_paths = [Path(path).resolve() for path in paths]
    common = os.path.commonpath([path.parent for path in whole_paths])
    return [str(path.relative_to(common)) for path in whole_paths]
