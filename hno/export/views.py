"""Rules for operations of torch that move entries and compute nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor

from hno.export.graph import Builder, Node
from hno.export.rules import Lowered, kind_of, rule


@rule("alias", "clone", "detach", "lift_fresh_copy", "contiguous")
def _same(b: Builder, out: Tensor, x: Node) -> Node:
    return x


@rule("_to_copy")
def _cast(b: Builder, out: Tensor, x: Node) -> Node:
    return b.cast(x, kind_of(out))


@rule("view", "unsqueeze", "squeeze", "_unsafe_view", "reshape")
def _reshape(b: Builder, out: Tensor, x: Node, *where: Any) -> Node:
    return b.reshape(x, out.shape)


@rule("expand")
def _expand(b: Builder, out: Tensor, x: Node, size: Sequence[int]) -> Node:
    return b.expand(x, out.shape)


@rule("permute")
def _permute(b: Builder, out: Tensor, x: Node, order: Sequence[int]) -> Node:
    return b.permute(x, [axis % len(order) for axis in order])


@rule("select")
def _select(b: Builder, out: Tensor, x: Node, dim: int, index: int) -> Node:
    place = index % x.shape[dim]
    return b.reshape(b.slice(x, dim % len(x.shape), place, place + 1), out.shape)


@rule("slice")
def _slice(b: Builder, out: Tensor, x: Node, dim: int = 0, start: Any = None, stop: Any = None, step: int = 1) -> Node:
    low, high, step = slice(start, stop, step).indices(x.shape[dim])
    return b.slice(x, dim % len(x.shape), low, high, step)


@rule("split_with_sizes", "split")
def _split(b: Builder, out: Sequence[Tensor], x: Node, sizes: Any, dim: int = 0) -> Lowered:
    """In parts along an axis."""
    parts, start = list[Node](), 0
    for part in out:
        parts.append(b.slice(x, dim % len(x.shape), start, start + part.shape[dim]))
        start += part.shape[dim]
    return tuple(parts)


@rule("cat")
def _cat(b: Builder, out: Tensor, parts: Sequence[Node], dim: int = 0) -> Node:
    return b.cat([b.cast(part, kind_of(out)) for part in parts], dim % out.dim())


@rule("flip")
def _flip(b: Builder, out: Tensor, x: Node, dims: Sequence[int]) -> Node:
    for dim in dims:
        x = b.take(x, dim % out.dim(), b.constant(np.arange(out.shape[dim])[::-1], "int"))
    return x


@rule("index_select")
def _index_select(b: Builder, out: Tensor, x: Node, dim: int, index: Node) -> Node:
    return b.take(x, dim % out.dim(), index)


@rule("index")
def _index(b: Builder, out: Tensor, x: Node, indices: Sequence[Node | None]) -> Node:
    places = [place for place, index in enumerate(indices) if index is not None]
    index = indices[places[0]]
    if len(places) != 1 or index is None or index.kind != "int":
        raise NotImplementedError("with several or Boolean indices")
    return b.take(x, places[0], index)


@rule("gather")
def _gather(b: Builder, out: Tensor, x: Node, dim: int, index: Node) -> Node:
    """Where other axes of the index have the sizes of those of x."""
    axis = dim % out.dim()
    if any(a != c for k, (a, c) in enumerate(zip(x.shape, index.shape, strict=True)) if k != axis):
        raise NotImplementedError("with an index of another shape")
    count = x.shape[axis]
    if index.value is not None:
        first = np.moveaxis(index.value, axis, -1).reshape(-1, index.shape[axis])
        if bool((first == first[:1]).all()):
            return b.take(x, axis, b.constant(first[0] % count, "int"))
    return b.node("gather", [x, index], out.shape, x.kind, axis=axis)


@rule("diagonal")
def _diagonal(b: Builder, out: Tensor, x: Node, offset: int = 0, dim1: int = 0, dim2: int = 1) -> Node:
    size, square = _square(b, x, offset, dim1, dim2)
    return b.reshape(b.slice(square, len(square.shape) - 1, 0, size * size, size + 1), out.shape)


@rule("diagonal_scatter")
def _diagonal_scatter(
    b: Builder, out: Tensor, x: Node, source: Node, offset: int = 0, dim1: int = 0, dim2: int = 1
) -> Node:
    size, square = _square(b, x, offset, dim1, dim2)
    grid = (*square.shape[:-1], size, size)
    rows = b.expand(b.reshape(source, (*source.shape, 1)), grid)
    on = b.constant(np.eye(size, dtype=bool), "bool")
    found = b.elementwise("where", [on, rows, b.reshape(square, grid)], grid, x.kind)
    last = [dim1 % out.dim(), dim2 % out.dim()]
    order = [axis for axis in range(out.dim()) if axis not in last] + last
    return b.permute(found, [order.index(axis) for axis in range(out.dim())])


def _square(b: Builder, x: Node, offset: int, dim1: int, dim2: int) -> tuple[int, Node]:
    """Two axes of equal size behind the others, as one."""
    count = len(x.shape)
    last = [dim1 % count, dim2 % count]
    size = x.shape[last[0]]
    if offset or size != x.shape[last[1]]:
        raise NotImplementedError("off the main diagonal")
    moved = b.permute(x, [axis for axis in range(count) if axis not in last] + last)
    return size, b.reshape(moved, (*moved.shape[:-2], size * size))


@rule("slice_scatter")
def _slice_scatter(
    b: Builder, out: Tensor, x: Node, source: Node, dim: int = 0, start: Any = None, stop: Any = None, step: int = 1
) -> Node:
    low, high, step = slice(start, stop, step).indices(out.shape[dim])
    if step != 1:
        raise NotImplementedError("in steps")
    axis = dim % out.dim()
    before, after = b.slice(x, axis, 0, low), b.slice(x, axis, high, out.shape[dim])
    return b.cat([before, source, after], axis) if high > low else x


@rule("select_scatter")
def _select_scatter(b: Builder, out: Tensor, x: Node, source: Node, dim: int, index: int) -> Lowered:
    axis = dim % out.dim()
    place = index % out.shape[axis]
    row = b.reshape(source, (*out.shape[:axis], 1, *out.shape[axis + 1 :]))
    return _slice_scatter(b, out, x, row, axis, place, place + 1)


@rule("index_put")
def _index_put(
    b: Builder, out: Tensor, x: Node, indices: Sequence[Node | None], values: Node, add: bool = False
) -> Node:
    """At known places of one axis, each once."""
    places = [place for place, index in enumerate(indices) if index is not None]
    index = indices[places[0]]
    axis = places[0]
    if len(places) != 1 or index is None or index.value is None or index.value.ndim != 1 or add:
        raise NotImplementedError("with places that depend on the state, or twice")
    spread = b.expand(values, (*out.shape[:axis], len(index.value), *out.shape[axis + 1 :]))
    where = {int(place) % out.shape[axis]: k for k, place in enumerate(index.value)}
    rows = [
        b.slice(spread, axis, where[k], where[k] + 1) if k in where else b.slice(x, axis, k, k + 1)
        for k in range(out.shape[axis])
    ]
    return b.cat(rows, axis)
