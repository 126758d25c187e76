"""One program for any batch from two that were traced with batches of different sizes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hno.export.graph import ELEMENTWISE, Builder, Kind, Node, Program, Shape, ordered


class BatchError(ValueError):
    """A function that does not treat the rows of a batch alike."""


def unified(one: Program, other: Program, sizes: tuple[int, int]) -> Program:
    """The program for any batch, from those that were traced with two sizes.

    Raises:
        BatchError: they differ in more than sizes that are multiples of the batch.
    """
    built, found = Builder(), dict[Node, Node]()
    nodes = ordered(one.outputs.values()), ordered(other.outputs.values())
    if len(nodes[0]) != len(nodes[1]):
        raise BatchError("it takes another number of operations in another batch")
    for a, b in zip(*nodes, strict=True):
        found[a] = _merged(
            built, a, b, tuple(_size(*pair, sizes) for pair in zip(a.shape, b.shape, strict=True)), found
        )
    outputs = {name: found[node] for name, node in one.outputs.items()}
    return Program({name: found[node] for name, node in one.inputs.items() if node in found}, outputs)


def _size(a: int, b: int, sizes: tuple[int, int]) -> int:
    if a == b:
        return a
    if a % sizes[0] or b % sizes[1] or a // sizes[0] != b // sizes[1]:
        raise BatchError(f"it has an axis of {a} entries in a batch of {sizes[0]}, and of {b} in one of {sizes[1]}")
    return -(a // sizes[0])


def _merged(built: Builder, a: Node, b: Node, shape: Shape, found: Mapping[Node, Node]) -> Node:
    if a.value is not None and b.value is not None:
        if a.shape == b.shape and np.array_equal(a.value, b.value, equal_nan=True):
            return built.constant(a.value, a.kind)
        return _rows(built, a.value, b.value, shape, a.kind)
    if (a.op, a.attributes) != (b.op, b.attributes):
        raise BatchError(f"{a.op} {dict(a.attributes)} in one batch is {b.op} {dict(b.attributes)} in another")
    if a.op == "input":
        return built.input(a.attributes["name"], shape)
    if a.op in ELEMENTWISE:
        return built.elementwise(a.op, [found[node] for node in a.inputs], shape, a.kind)
    return built.node(a.op, [found[node] for node in a.inputs], shape, a.kind, **a.attributes)


def _rows(built: Builder, a: NDArray[Any], b: NDArray[Any], shape: Shape, kind: Kind) -> Node:
    """A constant that has one row more for every further state, all alike, or each greater by the same."""
    step = (a[1:2] - a[:1]) if kind == "int" else np.zeros_like(a[:1])
    for value in (a, b):
        count = np.arange(len(value)).reshape(-1, *(1,) * (value.ndim - 1))
        if not np.array_equal(value, a[:1] + count * step if kind == "int" else np.repeat(a[:1], len(value), 0)):
            raise BatchError("it has constants that depend on the size of the batch")
    first = built.constant(a[:1], kind)
    if not step.any():
        return built.expand(first, shape)
    column = (shape[0], *(1,) * (len(shape) - 1))
    counted = built.node("iota", [], column, "int")
    scaled = built.elementwise("mul", [counted, built.constant(step, "int")], shape, "int")
    return built.elementwise("add", [scaled, first], shape, "int")
