"""A graph as Python that needs NumPy alone."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from numpy.typing import NDArray
from torch import Tensor

from hno.export.graph import ELEMENTWISE, Node, Program, Shape, ordered
from hno.export.stages import stage
from hno.export.templates import filled
from hno.export.trace import state_limits
from hno.games import Game
from hno.types import ROUNDING

INFIX = {
    "add": "+", "sub": "-", "mul": "*", "div": "/", "lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==",
    "ne": "!=", "and": "&", "or": "|", "remainder": "%",
}  # fmt: skip
FORMS = {name: f"({{0}} {sign} {{1}})" for name, sign in INFIX.items()} | {
    "neg": "-{0}", "not": "~{0}", "sigmoid": "0.5 * (1 + np.tanh(0.5 * {0}))", "relu": "np.maximum({0}, 0)",
    "asin": "np.arcsin({0})", "acos": "np.arccos({0})", "atan": "np.arctan({0})", "pow": "np.power({0}, {1})",
    "maximum": "np.maximum({0}, {1})", "minimum": "np.minimum({0}, {1})", "where": "np.where({0}, {1}, {2})",
}  # fmt: skip
TYPES = {"real": "np.float32", "int": "np.int64", "bool": "np.bool_"}


class Constants:
    """Constants of a file, each once: numbers as literals, reals in one block, the others as lists."""

    def __init__(self) -> None:
        self._names: dict[Any, str] = {}
        self._block: list[NDArray[Any]] = []
        self.lines: list[str] = []

    def __call__(self, node: Node) -> str:
        """How the file calls it."""
        value = node.value
        assert value is not None
        if value.ndim == 0:
            return repr(value.item()).replace("inf", "np.inf").replace("nan", "np.nan")
        key = value.shape, node.kind, value.tobytes()
        if key not in self._names:
            self._names[key] = name = f"_C{len(self._names)}"
            self.lines.append(f"{name} = {self._written(node, value)}")
        return self._names[key]

    def _written(self, node: Node, value: NDArray[Any]) -> str:
        if node.kind != "real":
            return f"np.array({value.tolist()}, {TYPES[node.kind]})"
        start = sum(part.size for part in self._block)
        self._block.append(value.astype("<f4"))
        return f"_BLOCK[{start}:{start + value.size}].reshape({value.shape})"

    def source(self) -> list[str]:
        """The lines that define them."""
        data = b"".join(part.tobytes() for part in self._block)
        text = base64.b64encode(data).decode()
        rows = [f'    "{text[k : k + 110]}"' for k in range(0, len(text), 110)] or ['    ""']
        return ["_BLOCK = np.frombuffer(base64.b64decode(", *rows, '), "<f4")', *self.lines]


def numpy_files(program: Program, single: Program, game: Game, about: str) -> dict[str, str]:
    """The file of a program of any batch, and of the same for one state."""
    low, high = state_limits(game)
    constants, margin = Constants(), ROUNDING * game.horizon
    lines = [*_functions(program, constants, ""), *_functions(single, constants, "1")]
    words = {
        "ABOUT": about, "OUTPUTS": tuple(program.outputs), "HORIZON": game.horizon, "EARLIEST": -margin,
        "LATEST": game.horizon + margin, "LOW": _listed(low), "HIGH": _listed(high),
        "GENERATED": "\n".join([*constants.source(), "", "", *lines]).rstrip(),
    }  # fmt: skip
    return {"controller.py": filled("controller.txt", words)}


def _listed(limits: Tensor) -> str:
    return repr(limits.tolist()).replace("inf", "np.inf")


def _functions(program: Program, constants: Constants, suffix: str) -> list[str]:
    """Lines of `_prepare`, `_control` and `_everything`, with a suffix, for tuples of what types alone determine."""
    early = stage(program.outputs.values(), frozenset(["theta"]))
    control = _function(f"_control{suffix}", ["prepared", "tau", "x"], [program.outputs["control"]], early, constants)
    rows = [f"_ROWS = {[abs(node.shape[0]) for node in early]}", "", ""]
    return [
        *(control if suffix else rows),
        *_function(f"_prepare{suffix}", ["theta"], early, (), constants),
        *_function(f"_everything{suffix}", ["prepared", "tau", "x"], program.outputs.values(), early, constants),
    ]


def _function(
    name: str, arguments: Sequence[str], outputs: Iterable[Node], given: Sequence[Node], constants: Constants
) -> list[str]:
    outputs, names = list(outputs), {node: f"p{k}" for k, node in enumerate(given)}
    lines = [f"def {name}({', '.join(arguments)}):"]
    nodes = ordered(outputs, given)
    used = {below for node in nodes for below in node.inputs} | set(outputs)
    if given:
        targets = ", ".join(names[node] if node in used else "_" for node in given)
        lines.append(f"    {targets}{',' * (len(given) == 1)} = prepared")
    if any(size < 0 for node in nodes if node.op in ("iota", "expand") for size in node.shape):
        lines.append("    n = len(tau)" if "tau" in arguments else "    n = len(theta)")
    for node in nodes:
        if node.op == "input":
            names[node] = node.attributes["name"]
        elif node.value is not None:
            names[node] = constants(node)
        else:
            names[node] = f"v{len(lines)}"
            lines.append(f"    {names[node]} = {expression(node, [names[below] for below in node.inputs])}")
    found = ", ".join(names[node] for node in outputs)
    return [*lines, f"    return ({found}{',' * (len(outputs) == 1)})", "", ""]


def expression(node: Node, inputs: Sequence[str]) -> str:
    """The Python expression of a node whose operands are variables."""
    if node.op == "cast":
        return f"{inputs[0]}.astype({TYPES[node.kind]})"
    if node.op in ELEMENTWISE:
        return FORMS.get(node.op, f"np.{node.op}({{0}})").format(*inputs)
    return _OTHERS[node.op](node, node.attributes, inputs)


def _sizes(shape: Shape) -> str:
    """A shape as an expression."""
    sizes = [str(size) if size >= 0 else "n" if size == -1 else f"{-size} * n" for size in shape]
    return f"({', '.join(sizes)}{',' * (len(sizes) == 1)})"


def _reshape(node: Node, _: Mapping[str, Any], inputs: Sequence[str]) -> str:
    (below,) = node.inputs
    axis = below.attributes.get("axis", 0)
    if below.op == "slice" and below.shape[axis] == 1 and node.shape == (*below.shape[:axis], *below.shape[axis + 1 :]):
        return f"{inputs[0]}[{':, ' * axis}0]"
    return f"{inputs[0]}.reshape({', '.join(str(max(size, -1)) for size in node.shape) or '()'})"


def _slice(node: Node, given: Mapping[str, Any], inputs: Sequence[str]) -> str:
    step = "" if given["step"] == 1 else f":{given['step']}"
    return f"{inputs[0]}[{':, ' * given['axis']}{given['start']}:{given['stop']}{step}]"


def _sort(node: Node, given: Mapping[str, Any], inputs: Sequence[str]) -> str:
    axis, sign = given["axis"], "-" * given["descending"]
    return f"{sign}np.sort({sign}{inputs[0]}, {axis})"


def _reduction(node: Node, given: Mapping[str, Any], inputs: Sequence[str]) -> str:
    axes = given["axes"]
    name = {"max": "max", "min": "min", "argmax": "argmax", "sum": "sum", "prod": "prod"}[node.op]
    return f"{inputs[0]}.{name}({axes[0] if len(axes) == 1 else axes})"


_OTHERS = {
    "reshape": _reshape,
    "expand": lambda node, given, inputs: f"np.broadcast_to({inputs[0]}, {_sizes(node.shape)})",
    "permute": lambda node, given, inputs: f"{inputs[0]}.transpose{given['order']}",
    "slice": _slice,
    "cat": lambda node, given, inputs: f"np.concatenate(({', '.join(inputs)}), {given['axis']})",
    "take": lambda node, given, inputs: f"{inputs[0]}.take({inputs[1]}, {given['axis']})",
    "gather": lambda node, given, inputs: f"np.take_along_axis({inputs[0]}, {inputs[1]}, {given['axis']})",
    "matmul": lambda node, given, inputs: f"{inputs[0]} @ {inputs[1]}",
    "iota": lambda node, given, inputs: f"np.arange({_sizes(node.shape[:1])[1:-2]}).reshape({_sizes(node.shape)})",
    "sort": _sort,
    **dict.fromkeys(("sum", "prod", "max", "min", "argmax"), _reduction),
}
