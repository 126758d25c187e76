"""What an exported function computes: a graph of few operations, each constant folded and each value computed once."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Kind = Literal["real", "int", "bool"]
DTYPES: dict[Kind, Any] = {"real": np.float64, "int": np.int64, "bool": np.bool_}
Shape = tuple[int, ...]
"""A negative size -k stands for k times the size of the batch."""

ELEMENTWISE = frozenset((
    "add", "sub", "mul", "div", "neg", "sin", "cos", "tan", "asin", "acos", "atan", "exp", "log", "sqrt", "abs",
    "floor", "tanh", "sigmoid", "relu", "maximum", "minimum", "pow", "remainder", "where", "lt", "le", "gt", "ge",
    "eq", "ne", "and", "or", "not", "cast",
))  # fmt: skip
"""Operations on every entry, whose operands are broadcast."""


@final
@dataclass(frozen=True, eq=False)
class Node:
    """One value of the computation."""

    op: str
    """One of `ELEMENTWISE`, or input, constant, iota, reshape, expand, permute, slice, cat, take, gather, matmul, sum,
    prod, max, min, argmax, sort."""
    inputs: tuple[Node, ...]
    shape: Shape
    kind: Kind
    attributes: Mapping[str, Any] = field(default_factory=dict)
    value: NDArray[Any] | None = None
    """Of a constant."""
    needs: frozenset[str] = frozenset()
    """Names of the inputs that it depends on."""


class Program(NamedTuple):
    """Named inputs and outputs of a graph."""

    inputs: dict[str, Node]
    outputs: dict[str, Node]

    def only(self, names: Iterable[str]) -> Program:
        """The part that computes these outputs."""
        return Program(self.inputs, {name: self.outputs[name] for name in names})


def ordered(outputs: Iterable[Node], given: Iterable[Node] = ()) -> list[Node]:
    """All nodes that outputs need, each after those that it needs itself; what is given needs nothing."""
    found, done = list[Node](), set(given)
    stack = [(node, iter(node.inputs)) for node in reversed(list(outputs)) if node not in done]
    while stack:
        node, rest = stack[-1]
        if node in done:
            stack.pop()
        elif (below := next(rest, None)) is None:
            done.add(node)
            found.append(node)
        elif below not in done:
            stack.append((below, iter(below.inputs)))
    return found


@final
class Builder:
    """Makes nodes: the same one for the same computation, and a simpler one where there is one."""

    def __init__(self) -> None:
        self._known: dict[Any, Node] = {}

    def input(self, name: str, shape: Sequence[int]) -> Node:
        """A named input."""
        return self._kept(
            ("input", name), Node("input", (), tuple(shape), "real", {"name": name}, None, frozenset([name]))
        )

    def constant(self, value: ArrayLike, kind: Kind = "real") -> Node:
        """A constant."""
        array = np.array(value, DTYPES[kind], order="C")
        return self._kept((kind, array.shape, array.tobytes()), Node("constant", (), array.shape, kind, {}, array))

    def node(self, op: str, inputs: Sequence[Node], shape: Sequence[int], kind: Kind, **attributes: Any) -> Node:
        """A node as it is."""
        needs = frozenset[str]().union(*(node.needs for node in inputs))
        key = op, tuple(map(id, inputs)), tuple(shape), kind, repr(sorted(attributes.items()))
        return self._kept(key, Node(op, tuple(inputs), tuple(shape), kind, attributes, None, needs))

    def _kept(self, key: object, node: Node) -> Node:
        return self._known.setdefault(key, node)

    def elementwise(self, op: str, inputs: Sequence[Node], shape: Sequence[int], kind: Kind) -> Node:
        """An operation on every entry; operands that were expanded are broadcast anyway."""
        shape = tuple(shape)
        narrow = [node.inputs[0] if node.op == "expand" else node for node in inputs]
        if _broadcast(narrow) == shape:
            inputs = narrow
        if (simpler := self._simpler(op, list(inputs), shape)) is not None:
            return simpler
        return self.node(op, inputs, shape, kind)

    def _simpler(self, op: str, inputs: list[Node], shape: Shape) -> Node | None:
        first, last = inputs[0], inputs[-1]
        if op == "where" and first.value is not None and first.value.all() == first.value.any():
            return self.expand(inputs[1] if first.value.any() else last, shape)
        if op in ("add", "mul") and first.value is not None:  # constants stand behind
            return (
                self.elementwise(op, [last, first], shape, "real")
                if last.value is None and first.kind == "real"
                else None
            )
        if last.value is None or last.kind != "real" or first.kind != "real" or len(inputs) != 2:
            return None
        if op == "div":
            return self.elementwise("mul", [first, self.constant(1 / last.value)], shape, "real")
        neutral = {"add": 0.0, "sub": 0.0, "mul": 1.0}.get(op)
        if neutral is not None and first.shape == shape and bool((last.value == neutral).all()):
            return first
        if op == "mul" and first.op == "mul" and (factor := first.inputs[1].value) is not None:
            return self.elementwise("mul", [first.inputs[0], self.constant(factor * last.value)], shape, "real")
        return None

    def reshape(self, node: Node, shape: Sequence[int]) -> Node:
        """The same entries in another shape."""
        while node.op == "reshape":
            (node,) = node.inputs
        if node.value is not None:
            return self.constant(node.value.reshape(shape), node.kind)
        return node if node.shape == tuple(shape) else self.node("reshape", [node], shape, node.kind)

    def expand(self, node: Node, shape: Sequence[int]) -> Node:
        """Broadcast."""
        return node if node.shape == tuple(shape) else self.node("expand", [node], shape, node.kind)

    def permute(self, node: Node, order: Sequence[int]) -> Node:
        """The axes in another order."""
        if list(order) == sorted(order):
            return node
        shape = [node.shape[axis] for axis in order]
        if [axis for axis in order if node.shape[axis] != 1] == [k for k, size in enumerate(node.shape) if size != 1]:
            return self.reshape(node, shape)
        if node.value is not None:
            return self.constant(node.value.transpose(order), node.kind)
        if node.op == "permute":
            return self.permute(node.inputs[0], [node.attributes["order"][axis] for axis in order])
        return self.node("permute", [node], shape, node.kind, order=tuple(order))

    def slice(self, node: Node, axis: int, start: int, stop: int, step: int = 1) -> Node:
        """Entries start, start + step, ... before stop of one axis."""
        count = len(range(start, stop, step))
        if count == node.shape[axis]:
            return node
        shape = (*node.shape[:axis], count, *node.shape[axis + 1 :])
        return self.node("slice", [node], shape, node.kind, axis=axis, start=start, stop=stop, step=step)

    def cat(self, parts: Sequence[Node], axis: int) -> Node:
        """One after the other; parts without entries are left out."""
        parts = [part for part in parts if 0 not in part.shape]
        if len(parts) == 1:
            return parts[0]
        shape = list(parts[0].shape)
        shape[axis] = sum(part.shape[axis] for part in parts)
        return self.node("cat", parts, shape, parts[0].kind, axis=axis)

    def take(self, node: Node, axis: int, index: Node) -> Node:
        """Entries of one axis, whose place the axes of the index take."""
        shape = (*node.shape[:axis], *index.shape, *node.shape[axis + 1 :])
        if index.value is not None:
            flat = index.value.ravel() % node.shape[axis]
            step = int(flat[1] - flat[0]) if len(flat) > 1 else 1
            if step > 0 and bool((np.diff(flat) == step).all()):
                part = self.slice(node, axis, int(flat[0]), int(flat[-1]) + 1, step)
                return self.reshape(part, shape)
        return self.node("take", [node, index], shape, node.kind, axis=axis)

    def reduce(self, op: str, node: Node, axes: Sequence[int], shape: Sequence[int]) -> Node:
        """sum, prod, max, min or argmax over some axes."""
        if op != "argmax" and all(node.shape[axis] == 1 for axis in axes):
            return self.reshape(node, shape)
        if op == "sum" and node.op == "mul" and list(axes) == [len(node.shape) - 1]:
            for row, table in (node.inputs, node.inputs[::-1]):
                if row.shape[-2:-1] == (1,) and row.shape == (*table.shape[:-2], 1, table.shape[-1]):
                    column = self.reshape(row, (*row.shape[:-2], row.shape[-1], 1))
                    return self.reshape(self.node("matmul", [table, column], (*table.shape[:-1], 1), "real"), shape)
        kept = [size for axis, size in enumerate(node.shape) if axis not in axes]
        kind: Kind = "int" if op == "argmax" else node.kind
        return self.reshape(self.node(op, [node], kept, kind, axes=tuple(axes)), shape)

    def cast(self, node: Node, kind: Kind) -> Node:
        """As another kind of number."""
        if node.kind == kind:
            return node
        if node.value is not None:
            return self.constant(node.value, kind)
        return self.node("cast", [node], node.shape, kind)


def _broadcast(nodes: Sequence[Node]) -> Shape:
    """The shape to which operands are broadcast; of sizes that do not fit, any."""
    columns = itertools.zip_longest(*(reversed(node.shape) for node in nodes), fillvalue=1)
    return tuple(next((size for size in sizes if size != 1), 1) for sizes in columns)[::-1]
