"""Entries of a configuration that must be numbers or flags; true and false are no numbers."""

from __future__ import annotations

import math


def is_number(value: object) -> bool:
    """Whether an entry is a whole or floating-point number."""
    return type(value) in (int, float)


def whole_number(name: str, value: object, least: int, why: str = "") -> None:
    """Raise ValueError unless an entry is a whole number of at least `least` (`why` says where that comes from)."""
    if not (type(value) is int and value >= least):
        raise ValueError(f"{name} must be a whole number of at least {least}{why and ', ' + why}; got {value!r}.")


def finite_number(name: str, value: object) -> None:
    """Raise ValueError unless an entry is a finite number of at least 0."""
    if not (is_number(value) and 0 <= value < math.inf):  # type: ignore[operator]  # a number
        raise ValueError(f"{name} must be a finite number of at least 0; got {value!r}.")


def flag(name: str, value: object) -> None:
    """Raise ValueError unless an entry is true or false."""
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be true or false; got {value!r}.")
