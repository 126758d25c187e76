"""Which operations of torch (core aten) are known, and those that compute; others move entries (`views`)."""

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
