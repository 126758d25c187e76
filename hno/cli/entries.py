"""Entries of a configuration, each with what it must be."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any

from pydantic import PlainValidator

LARGEST_SEED = 2**32 - 1


def must(expected: str, met: Callable[[Any], bool]) -> PlainValidator:
    """A validator that says what it expected."""

    def check(value: Any) -> Any:
        if not met(value):
            raise ValueError(f" must be {expected}; got {value!r}.")
        return value

    return PlainValidator(check)


def number(value: object) -> bool:
    """Whether an entry is a finite number; true and false are none."""
    return type(value) in (int, float) and math.isfinite(value)  # type: ignore[arg-type]  # a number


def whole(least: int, most: float = math.inf, expected: str = "") -> PlainValidator:
    """A whole number in a range."""
    expected = expected or f"a whole number of at least {least}"
    return must(expected, lambda value: type(value) is int and least <= value <= most)


def one_of(*known: str) -> PlainValidator:
    """One of a few names."""
    return must(f"one of {', '.join(known)}", lambda value: value in known)


def _types(value: Any) -> Any:
    """Player types as `hno.games.grid.parse_types` takes them."""
    if type(value) in (int, float):
        return str(value)
    if not (value is None or (isinstance(value, (str, list)) and value != "")):
        raise ValueError(f" must name player types, or list them as 1,1;2.5,4 or [[1, 1], [2.5, 4]]; got {value!r}.")
    return value


Flag = Annotated[bool, must("true or false", lambda value: isinstance(value, bool))]
Text = Annotated[str, must("text", lambda value: isinstance(value, str) and value != "")]
Texts = Annotated[list[str], must("a list", lambda v: isinstance(v, list) and all(isinstance(e, str) for e in v))]
Size = Annotated[int, whole(1)]
Count = Annotated[int, whole(0)]
Seed = Annotated[int, whole(0, LARGEST_SEED, f"a whole number from 0 to {LARGEST_SEED}")]
Positive = Annotated[float, must("a positive number", lambda value: number(value) and value > 0)]
Amount = Annotated[float, must("a finite number of at least 0", lambda value: number(value) and value >= 0)]
Share = Annotated[float, must("a share of the run, from 0 to 1", lambda value: number(value) and 0 <= value <= 1)]
Types = Annotated[Any, PlainValidator(_types)]
Paths = Annotated[
    Any, must("a checkpoint, the folder of a run, or a list of them", lambda v: bool(v) and isinstance(v, (str, list)))
]
Device = Annotated[Any, must("one of Lightning's", lambda v: v is not None and not isinstance(v, bool))]
