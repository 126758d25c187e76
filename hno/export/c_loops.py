"""Loops, arrays and constants in C."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hno.export.graph import Kind

TYPES: dict[Kind, str] = {"real": "float", "int": "int", "bool": "int"}


class Place(NamedTuple):
    """Where the entries of a node lie."""

    array: str
    offset: int
    strides: tuple[int, ...]

    def at(self, index: Sequence[str]) -> str:
        """An entry, in C."""
        terms = [
            i if stride == 1 else f"{stride} * {i}"
            for i, stride in zip(index, self.strides, strict=True)
            if stride and i != "0"
        ]
        return f"{self.array}[{' + '.join([*([str(self.offset)] if self.offset or not terms else []), *terms])}]"


class Constants:
    """Constant arrays of a file, each once."""

    def __init__(self) -> None:
        self._names: dict[Any, str] = {}
        self.lines: list[str] = []

    def place(self, value: NDArray[Any], kind: Kind) -> Place:
        """Where a constant lies."""
        key = kind, value.tobytes()
        if key not in self._names:
            self._names[key] = name = f"c{len(self._names)}"
            entries = [literal(entry, kind) for entry in value.ravel().tolist()]
            rows = [", ".join(entries[k : k + 8]) for k in range(0, len(entries), 8)]
            self.lines.append(
                f"static const {TYPES[kind]} {name}[{value.size}] = {{\n    " + ",\n    ".join(rows) + "};"
            )
        return Place(self._names[key], 0, strides_of(value.shape))


def literal(entry: float, kind: Kind) -> str:
    """A number in C."""
    if kind != "real":
        return str(int(entry))
    if math.isinf(entry):
        return "INFINITY" if entry > 0 else "-INFINITY"
    text = np.format_float_scientific(np.float32(entry), trim="0")
    return f"{text}f"


def strides_of(shape: Sequence[int]) -> tuple[int, ...]:
    """Those of an array whose last axis runs fastest."""
    return tuple(math.prod(shape[axis + 1 :]) for axis in range(len(shape)))


LANES = 8
"""Running totals of a long sum: one would wait for itself."""
Named = Callable[[str], str]


def total(
    target: str, run: Sequence[tuple[str, int]], entry: Callable[[Named], str], start: str, step: str
) -> list[str]:
    """Statements that gather entries, which are given for what the loops are named, in a target."""
    if len(run) != 1 or run[0][1] % LANES or run[0][1] == LANES:
        return [f"{target} = {start};", *nested(run, [step.format(target, entry(lambda name: name))])]
    (name, count), lanes = run[0], [("l", LANES)]
    moved = entry(lambda given: f"({name} + l)" if given == name else given)
    return [
        f"float s[{LANES}];",
        *nested(lanes, [f"s[l] = {start};"]),
        f"for (int {name} = 0; {name} < {count}; {name} += {LANES})",
        *nested(lanes, ["    " + step.format("s[l]", moved)]),
        f"{target} = {start};",
        *nested(lanes, [step.format(target, "s[l]")]),
    ]


def indices(shape: Sequence[int]) -> list[str]:
    """Names of the loops over a shape; an axis of one entry has none."""
    return ["0" if size == 1 else f"i{axis}" for axis, size in enumerate(shape)]


def loops(shape: Sequence[int], body: Sequence[str]) -> list[str]:
    """Statements for every entry."""
    return nested(list(zip(indices(shape), shape, strict=True)), body)


def nested(sizes: Sequence[tuple[str, int]], body: Sequence[str]) -> list[str]:
    """Statements in loops of these names and sizes."""
    sizes = [(name, size) for name, size in sizes if name != "0"]
    lines = [
        f"{'    ' * depth}for (int {name} = 0; {name} < {size}; {name}++)" for depth, (name, size) in enumerate(sizes)
    ]
    pad = "    " * len(sizes)
    if len(body) == 1:
        return [*lines, f"{pad}{body[0]}"]
    return [*lines, f"{pad}{{", *(f"{pad}    {line}" for line in body), f"{pad}}}"]


def reshaped(shape: Sequence[int], strides: Sequence[int], wanted: Sequence[int]) -> tuple[int, ...] | None:
    """Strides of the same memory in another shape, where there are some."""
    runs = list[tuple[int, int]]()  # of entries with one stride, from the front
    for size, stride in zip(shape, strides, strict=True):
        if size == 1:
            continue
        if runs and runs[-1][1] == size * stride:
            runs[-1] = runs[-1][0] * size, stride
        else:
            runs.append((size, stride))
    found, left = list[int](), runs[::-1]
    room, step = left.pop() if left else (1, 0)
    for size in wanted:
        if size == 1:
            found.append(0)
            continue
        if room == 1 and left:
            room, step = left.pop()
        if room % size:
            return None
        room //= size
        found.append(step * room)
    return tuple(found)
