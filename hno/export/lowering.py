"""From operations of torch (core aten) to those of a graph; an operation that is not listed here is refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from hno.export.graph import Builder, Kind, Node

Lowered = Node | tuple[Node | None, ...]
Rule = Callable[..., Lowered]
RULES: dict[str, Rule] = {}
"""By the name of the operation: (builder, result, *arguments) -> node."""
ELEMENTWISE = {name: name for name in (
    "sin", "cos", "tan", "asin", "acos", "atan", "exp", "log", "sqrt", "abs", "floor", "tanh", "sigmoid", "relu", "neg",
    "maximum", "minimum", "lt", "le", "gt", "ge", "eq", "ne", "mul", "div", "where", "remainder",
)} | {
    "bitwise_not": "not", "logical_not": "not", "bitwise_and": "and", "logical_and": "and", "bitwise_or": "or",
    "logical_or": "or",
}  # fmt: skip
"""Operations on every entry, by torch's names and the graph's."""
FREE = (
    "arange",
    "full",
    "scalar_tensor",
    "full_like",
    "zeros_like",
    "ones_like",
    "empty_like",
    "new_zeros",
    "new_full",
)
"""Operations whose result depends on no entry of any tensor."""


class UnsupportedError(ValueError):
    """A function with an operation that cannot be exported."""


def lowered(builder: Builder, name: str, result: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    """The node of a call of an operation, or a tuple of them.

    Args:
        builder: makes it.
        name: of the operation, such as "aten.add.Tensor".
        result: what it gave.
        args: nodes where it got tensors, and plain values.
        kwargs: likewise.

    Raises:
        UnsupportedError: it is not on the list; the message has its name.
    """
    kind = name.split(".")[1] if "." in name else name
    given = [node for arg in (*args, *kwargs.values()) for node in (arg if isinstance(arg, list) else [arg])]
    if kind in FREE or all(node.value is not None for node in given if isinstance(node, Node)):
        several = isinstance(result, (tuple, list))
        return tuple(constant(builder, part) for part in result) if several else constant(builder, result)
    try:
        if kind in ELEMENTWISE:
            return elementwise(builder, ELEMENTWISE[kind], result, *args)
        return RULES[kind](builder, result, *args, **{key: kwargs[key] for key in kwargs if key in NAMED})
    except (KeyError, NotImplementedError) as error:
        detail = f" {error}" if isinstance(error, NotImplementedError) else ""
        known = ", ".join(sorted({*RULES, *ELEMENTWISE, *FREE}))
        raise UnsupportedError(
            f"{name}{detail} cannot be exported. Write the game's sensors, terminal value and best response, or the "
            f"network, with other operations: {known}."
        ) from error


NAMED = ("alpha", "beta", "keepdim")


def constant(builder: Builder, result: Tensor) -> Node:
    """A tensor's value."""
    return builder.constant(result.detach().cpu().resolve_conj().numpy(), kind_of(result))


def kind_of(tensor: Tensor) -> Kind:
    """Kind of numbers."""
    return "real" if tensor.is_floating_point() else "bool" if str(tensor.dtype) == "torch.bool" else "int"


def elementwise(builder: Builder, op: str, result: Tensor, *args: Any) -> Node:
    """Operands of one kind, numbers as constants."""
    nodes = [arg if isinstance(arg, Node) else builder.constant(arg, _kind(arg)) for arg in args]
    kinds = [node.kind for node in nodes[1 if op == "where" else 0 :]]
    common: Kind = "real" if "real" in kinds or kind_of(result) == "real" else "int" if "int" in kinds else "bool"
    cast = [builder.cast(node, common) for node in nodes]
    if op == "where":
        cast[0] = nodes[0]
    return builder.elementwise(op, cast, result.shape, kind_of(result))


def _kind(number: object) -> Kind:
    return "bool" if isinstance(number, bool) else "int" if isinstance(number, int) else "real"


def rule(*names: str) -> Callable[[Rule], Rule]:
    """Register a rule."""

    def add(function: Rule) -> Rule:
        RULES.update(dict.fromkeys(names, function))
        return function

    return add


def _sum_rule(op: str) -> Rule:
    def lower(b: Builder, out: Tensor, x: Any, y: Any, alpha: float = 1) -> Node:
        scaled = y if alpha == 1 else elementwise(b, "mul", out, y, alpha)
        return elementwise(b, op, out, x, scaled)

    return lower


RULES.update(add=_sum_rule("add"), sub=_sum_rule("sub"))


@rule("rsub")
def _rsub(b: Builder, out: Tensor, x: Any, y: Any) -> Node:
    return elementwise(b, "sub", out, y, x)


@rule("reciprocal")
def _reciprocal(b: Builder, out: Tensor, x: Node) -> Node:
    return elementwise(b, "div", out, 1.0, x)


@rule("clamp")
def _clamp(b: Builder, out: Tensor, x: Node, low: Any = None, high: Any = None) -> Node:
    found = x if low is None else elementwise(b, "maximum", out, x, low)
    return found if high is None else elementwise(b, "minimum", out, found, high)


@rule("pow")
def _pow(b: Builder, out: Tensor, x: Any, exponent: Any) -> Node:
    if exponent == 1:
        return b.cast(x, kind_of(out))
    if exponent == 2:
        return elementwise(b, "mul", out, x, x)
    if exponent == 0.5:
        return elementwise(b, "sqrt", out, x)
    if isinstance(exponent, (int, float)) and exponent < 0:
        power = out if exponent == -1 else _pow(b, out, x, -exponent)
        return elementwise(b, "div", out, 1.0, x if exponent == -1 else power)
    return elementwise(b, "pow", out, x, exponent)


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


@rule("mm", "bmm")
def _matmul(b: Builder, out: Tensor, x: Node, y: Node) -> Node:
    return b.node("matmul", [x, y], out.shape, "real")


@rule("addmm", "baddbmm")
def _addmm(b: Builder, out: Tensor, bias: Node, x: Node, y: Node, beta: float = 1, alpha: float = 1) -> Node:
    if (beta, alpha) != (1, 1):
        raise NotImplementedError("with factors")
    return elementwise(b, "add", out, _matmul(b, out, x, y), bias)


def _axes(x: Node, dims: Any) -> list[int]:
    chosen = range(len(x.shape)) if dims is None or dims == [] else [dims] if isinstance(dims, int) else dims
    return sorted(dim % len(x.shape) for dim in chosen)


def _reduction(op: str) -> Rule:
    def lower(b: Builder, out: Tensor, x: Node, dims: Any = None, keepdim: bool = False) -> Node:
        return b.reduce(op, x if op == "argmax" else b.cast(x, kind_of(out)), _axes(x, dims), out.shape)

    return lower


RULES.update(sum=_reduction("sum"), prod=_reduction("prod"), amax=_reduction("max"), amin=_reduction("min"))
RULES.update(argmax=_reduction("argmax"))


@rule("mean")
def _mean(b: Builder, out: Tensor, x: Node, dims: Any = None, keepdim: bool = False) -> Node:
    axes = _axes(x, dims)
    total = b.reduce("sum", x, axes, out.shape)
    return elementwise(b, "mul", out, total, 1 / float(np.prod([x.shape[axis] for axis in axes])))


@rule("sort")
def _sort(b: Builder, out: Sequence[Tensor], x: Node, dim: int = -1, descending: bool = False) -> Lowered:
    """The values; where they came from is not known."""
    return _sorted(b, x, dim % len(x.shape), descending), None


def _sorted(b: Builder, x: Node, axis: int, descending: bool) -> Node:
    return x if x.shape[axis] == 1 else b.node("sort", [x], x.shape, x.kind, axis=axis, descending=descending)


@rule("median")
def _median(b: Builder, out: Sequence[Tensor], x: Node, dim: int = -1, keepdim: bool = False) -> Lowered:
    """The middle one; the lower one of two."""
    axis = dim % len(x.shape)
    middle = (x.shape[axis] - 1) // 2
    return b.reshape(b.slice(_sorted(b, x, axis, descending=False), axis, middle, middle + 1), out[0].shape), None
