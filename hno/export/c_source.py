"""A graph of one state as C99: loops over arrays on the stack, constants in the file, no library but that of C."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hno.export.graph import ELEMENTWISE, Kind, Node, ordered, users

TYPES: dict[Kind, str] = {"real": "float", "int": "int", "bool": "int"}
FORMS = {
    "add": "({0} + {1})", "sub": "({0} - {1})", "mul": "({0} * {1})", "div": "({0} / {1})", "neg": "(-{0})",
    "lt": "({0} < {1})", "le": "({0} <= {1})", "gt": "({0} > {1})", "ge": "({0} >= {1})", "eq": "({0} == {1})",
    "ne": "({0} != {1})", "and": "({0} && {1})", "or": "({0} || {1})", "not": "(!{0})", "abs": "fabsf({0})",
    "where": "({0} ? {1} : {2})", "maximum": "larger({0}, {1})", "minimum": "smaller({0}, {1})",
    "sigmoid": "(1.0f / (1.0f + expf(-{0})))", "relu": "larger({0}, 0.0f)", "pow": "powf({0}, {1})",
}  # fmt: skip
VIEWS = ("reshape", "expand", "permute", "slice")


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
        return Place(self._names[key], 0, _strides(value.shape))


def literal(entry: float, kind: Kind) -> str:
    """A number in C."""
    if kind != "real":
        return str(int(entry))
    if math.isinf(entry):
        return "INFINITY" if entry > 0 else "-INFINITY"
    text = np.format_float_scientific(np.float32(entry), trim="0")
    return f"{text}f"


def _strides(shape: Sequence[int]) -> tuple[int, ...]:
    return tuple(math.prod(shape[axis + 1 :]) for axis in range(len(shape)))


class Body:
    """Statements that compute nodes, in the order in which they are asked for.

    Args:
        constants: of the file.
        places: where what is given lies.
        outputs: of the whole function; what one other node alone needs is computed in its place.
    """

    def __init__(self, constants: Constants, places: Mapping[Node, Place], outputs: Iterable[Node]) -> None:
        self.constants, self.places = constants, dict(places)
        self.lines: list[str] = []
        nodes, ends = ordered(outputs, places), set(outputs)
        self._inline = {
            node
            for node, above in users(nodes).items()
            if node.op in ELEMENTWISE and len(above) == 1 and node not in ends and node not in self.places
            and above[0].op in (*ELEMENTWISE, "sum") and (above[0].op == "sum" or above[0].shape == node.shape)
        }  # fmt: skip

    def compute(self, nodes: Iterable[Node]) -> None:
        """Statements for nodes that come in an order in which they can be computed."""
        for node in nodes:
            if node in self.places or node in self._inline or (node.value is not None and node.value.ndim == 0):
                continue
            if node.value is not None:
                self.places[node] = self.constants.place(node.value, node.kind)
            elif (view := self._view(node)) is not None:
                self.places[node] = view
            else:
                self._compute(node)

    def _view(self, node: Node) -> Place | None:
        """The same memory, seen otherwise."""
        if node.op not in VIEWS or node.inputs[0] in self._inline:
            return None
        (below,), given = node.inputs, node.attributes
        place = self._place(below)
        strides = place.strides
        if node.op == "permute":
            return place._replace(strides=tuple(strides[axis] for axis in given["order"]))
        if node.op == "slice":
            axis, start, step = given["axis"], given["start"], given["step"]
            moved = tuple(stride * (step if k == axis else 1) for k, stride in enumerate(strides))
            return Place(place.array, place.offset + start * strides[axis], moved)
        if node.op == "expand":
            missing = len(node.shape) - len(below.shape)
            sizes = zip(strides, below.shape, strict=True)
            return place._replace(strides=(*(0,) * missing, *(0 if size == 1 else stride for stride, size in sizes)))
        found = _reshaped(below.shape, strides, node.shape)
        return None if found is None else place._replace(strides=found)

    def _place(self, node: Node) -> Place:
        if node not in self.places:
            self.compute([node])
        return self.places[node]

    def load(self, node: Node, index: Sequence[str]) -> str:
        """An entry of a node, broadcast to more axes, in C."""
        index = index[len(index) - len(node.shape) :]
        if node.value is not None and node.value.ndim == 0:
            return literal(node.value.item(), node.kind)
        if node in self._inline:
            return self._entry(node, index)
        own = ["0" if size == 1 else i for i, size in zip(index, node.shape, strict=True)]
        return self._place(node).at(own)

    def _entry(self, node: Node, index: Sequence[str]) -> str:
        """An elementwise operation."""
        operands = [self.load(below, index) for below in node.inputs]
        if node.op == "cast":
            return f"({operands[0]} != 0)" if node.kind == "bool" else f"({TYPES[node.kind]}){operands[0]}"
        if node.op == "remainder":
            return (f"wrapped({operands[0]}, {operands[1]})" if node.kind == "int"
                    else f"({operands[0]} - {operands[1]} * floorf({operands[0]} / {operands[1]}))")  # fmt: skip
        form = FORMS.get(node.op, f"{node.op}f({{0}})")
        if node.kind == "int" and node.op in ("maximum", "minimum", "abs", "relu"):
            raise NotImplementedError(f"{node.op} of whole numbers")
        return form.format(*operands)

    def _compute(self, node: Node) -> None:
        name = f"v{len(self.places)}"
        size = math.prod(node.shape)
        self.places[node] = Place(name, 0, _strides(node.shape))
        emit = getattr(self, f"_{node.op}", self._elementwise)
        body = emit(node, self.places[node])
        self.lines += [f"{TYPES[node.kind]} {name}[{size}];", *body]

    def _elementwise(self, node: Node, place: Place) -> list[str]:
        source = node.inputs[0] if node.op in VIEWS else None
        if source is not None and node.op == "reshape":  # memory in no order that a view can have
            index = _indices(source.shape)
            target = Place(place.array, 0, _strides(source.shape))
            return loops(source.shape, [f"{target.at(index)} = {self.load(source, index)};"])
        index = _indices(node.shape)
        return loops(node.shape, [f"{place.at(index)} = {self._entry(node, index)};"])

    def _cat(self, node: Node, place: Place) -> list[str]:
        lines, start, axis = list[str](), 0, node.attributes["axis"]
        for part in node.inputs:
            index = _indices(part.shape)
            target = place._replace(offset=start * place.strides[axis])
            lines += loops(part.shape, [f"{target.at(index)} = {self.load(part, index)};"])
            start += part.shape[axis]
        return lines

    def _take(self, node: Node, place: Place) -> list[str]:
        source, where = node.inputs
        axis, index = node.attributes["axis"], _indices(node.shape)
        places = index[axis : axis + len(where.shape)]
        entry = [*index[:axis], self.load(where, places), *index[axis + len(where.shape) :]]
        return loops(node.shape, [f"{place.at(index)} = {self.load(source, entry)};"])

    def _gather(self, node: Node, place: Place) -> list[str]:
        source, where = node.inputs
        axis, index = node.attributes["axis"], _indices(node.shape)
        entry = [*index[:axis], self.load(where, index), *index[axis + 1 :]]
        return loops(node.shape, [f"{place.at(index)} = {self.load(source, entry)};"])

    def _matmul(self, node: Node, place: Place) -> list[str]:
        """The innermost loop runs over what lies side by side."""
        left, right = node.inputs
        index, inner = _indices(node.shape), left.shape[-1]
        *outer, i, j = index
        sizes = list(zip(index, node.shape, strict=True))
        if j == "0" and left.value is None:  # each row is a sum

            def product(named: Named) -> str:
                return f"{self.load(left, [*outer, i, named('k')])} * {self.load(right, [*outer, named('k'), j])}"

            return _nested(sizes, _total(place.at(index), [("k", inner)], product, "0.0f", "{0} += {1};"))
        load, times = self.load(left, [*outer, i, "k"]), self.load(right, [*outer, "k", j])
        if j == "0" and left.value is not None and left.value.ndim == 2:  # its columns
            load = self.constants.place(np.ascontiguousarray(left.value.T), "real").at(["k", i])
        sizes.insert(-2 if j == "0" else -1, ("k", inner))
        return [
            *loops(node.shape, [f"{place.at(index)} = 0.0f;"]),
            *_nested(sizes, [f"{place.at(index)} += {load} * {times};"]),
        ]

    def _sum(self, node: Node, place: Place) -> list[str]:
        return self._reduced(node, place, "0.0f" if node.kind == "real" else "0", "{0} += {1};")

    def _prod(self, node: Node, place: Place) -> list[str]:
        return self._reduced(node, place, "1.0f" if node.kind == "real" else "1", "{0} *= {1};")

    def _max(self, node: Node, place: Place) -> list[str]:
        return self._reduced(node, place, "-INFINITY", "{0} = larger({0}, {1});")

    def _min(self, node: Node, place: Place) -> list[str]:
        return self._reduced(node, place, "INFINITY", "{0} = smaller({0}, {1});")

    def _reduced(self, node: Node, place: Place, start: str, step: str) -> list[str]:
        (below,), axes = node.inputs, node.attributes["axes"]
        index = _indices(below.shape)
        sizes = list(enumerate(zip(index, below.shape, strict=True)))
        kept, run = ([pair for axis, pair in sizes if (axis in axes) == among] for among in (False, True))
        target = place.at([i for i, _ in kept])
        return _nested(
            kept, _total(target, run, lambda named: self.load(below, [named(i) for i in index]), start, step)
        )

    def _argmax(self, node: Node, place: Place) -> list[str]:
        (below,), (axis,) = node.inputs, node.attributes["axes"]
        index = _indices(below.shape)
        kept = [i for k, i in enumerate(index) if k != axis]
        best = [place.at(kept) if k == axis else i for k, i in enumerate(index)]
        name, target = index[axis], place.at(kept)
        step = [f"if ({self.load(below, index)} > {self.load(below, best)}) {target} = {name};"]
        body = [f"{target} = 0;", *_nested([(name, below.shape[axis])], step)]
        return _nested([(i, below.shape[k]) for k, i in enumerate(index) if k != axis], body)

    def _sort(self, node: Node, place: Place) -> list[str]:
        """By insertion."""
        (below,), axis, index = node.inputs, node.attributes["axis"], _indices(node.shape)
        sign, stride = "<" if node.attributes["descending"] else ">", place.strides[axis]
        name, kept = index[axis], [(i, node.shape[k]) for k, i in enumerate(index) if k != axis]
        first = place.at(["0" if i == name else i for i in index])
        body = [
            f"{TYPES[node.kind]} entry = {self.load(below, index)}, *row = &{first};",
            f"int at = {name};",
            f"for (; at > 0 && row[(at - 1) * {stride}] {sign} entry; at--)",
            f"    row[at * {stride}] = row[(at - 1) * {stride}];",
            f"row[at * {stride}] = entry;",
        ]
        return _nested([*kept, (name, node.shape[axis])], body)

    def store(self, node: Node, array: str) -> None:
        """A statement that copies a node."""
        index = _indices(node.shape)
        target = Place(array, 0, _strides(node.shape))
        self.lines += loops(node.shape, [f"{target.at(index)} = {self.load(node, index)};"])


LANES = 8
"""Running totals of a long sum: one would wait for itself."""
Named = Callable[[str], str]


def _total(
    target: str, run: Sequence[tuple[str, int]], entry: Callable[[Named], str], start: str, step: str
) -> list[str]:
    """Statements that gather entries, which are given for what the loops are named, in a target."""
    if len(run) != 1 or run[0][1] % LANES or run[0][1] == LANES:
        return [f"{target} = {start};", *_nested(run, [step.format(target, entry(lambda name: name))])]
    (name, count), lanes = run[0], [("l", LANES)]
    moved = entry(lambda given: f"({name} + l)" if given == name else given)
    return [
        f"float s[{LANES}];",
        *_nested(lanes, [f"s[l] = {start};"]),
        f"for (int {name} = 0; {name} < {count}; {name} += {LANES})",
        *_nested(lanes, ["    " + step.format("s[l]", moved)]),
        f"{target} = {start};",
        *_nested(lanes, [step.format(target, "s[l]")]),
    ]


def _indices(shape: Sequence[int]) -> list[str]:
    """Names of the loops over a shape; an axis of one entry has none."""
    return ["0" if size == 1 else f"i{axis}" for axis, size in enumerate(shape)]


def loops(shape: Sequence[int], body: Sequence[str]) -> list[str]:
    """Statements for every entry."""
    return _nested(list(zip(_indices(shape), shape, strict=True)), body)


def _nested(sizes: Sequence[tuple[str, int]], body: Sequence[str]) -> list[str]:
    sizes = [(name, size) for name, size in sizes if name != "0"]
    lines = [
        f"{'    ' * depth}for (int {name} = 0; {name} < {size}; {name}++)" for depth, (name, size) in enumerate(sizes)
    ]
    pad = "    " * len(sizes)
    if len(body) == 1:
        return [*lines, f"{pad}{body[0]}"]
    return [*lines, f"{pad}{{", *(f"{pad}    {line}" for line in body), f"{pad}}}"]


def _reshaped(shape: Sequence[int], strides: Sequence[int], wanted: Sequence[int]) -> tuple[int, ...] | None:
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


def split(nodes: Sequence[Node], name: str) -> tuple[list[Node], list[Node]]:
    """Nodes that do not depend on an input, and those that do."""
    apart = [[node for node in nodes if (name in node.needs) == depends] for depends in (False, True)]
    return apart[0], apart[1]
