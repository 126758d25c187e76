"""A graph of one state as C99: loops over arrays on the stack, constants in the file, no library but that of C."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from hno.export.c_loops import (
    TYPES,
    Constants,
    Named,
    Place,
    indices,
    literal,
    loops,
    nested,
    reshaped,
    strides_of,
    total,
)  # fmt: skip
from hno.export.graph import ELEMENTWISE, Node, ordered
from hno.export.stages import users

FORMS = {
    "add": "({0} + {1})", "sub": "({0} - {1})", "mul": "({0} * {1})", "div": "({0} / {1})", "neg": "(-{0})",
    "lt": "({0} < {1})", "le": "({0} <= {1})", "gt": "({0} > {1})", "ge": "({0} >= {1})", "eq": "({0} == {1})",
    "ne": "({0} != {1})", "and": "({0} && {1})", "or": "({0} || {1})", "not": "(!{0})", "abs": "fabsf({0})",
    "where": "({0} ? {1} : {2})", "maximum": "larger({0}, {1})", "minimum": "smaller({0}, {1})",
    "sigmoid": "(1.0f / (1.0f + expf(-{0})))", "relu": "larger({0}, 0.0f)", "pow": "powf({0}, {1})",
}  # fmt: skip
VIEWS = ("reshape", "expand", "permute", "slice")


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
        found = reshaped(below.shape, strides, node.shape)
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
        self.places[node] = Place(name, 0, strides_of(node.shape))
        emit = getattr(self, f"_{node.op}", self._elementwise)
        body = emit(node, self.places[node])
        self.lines += [f"{TYPES[node.kind]} {name}[{size}];", *body]

    def _elementwise(self, node: Node, place: Place) -> list[str]:
        source = node.inputs[0] if node.op in VIEWS else None
        if source is not None and node.op == "reshape":  # memory in no order that a view can have
            index = indices(source.shape)
            target = Place(place.array, 0, strides_of(source.shape))
            return loops(source.shape, [f"{target.at(index)} = {self.load(source, index)};"])
        index = indices(node.shape)
        return loops(node.shape, [f"{place.at(index)} = {self._entry(node, index)};"])

    def _cat(self, node: Node, place: Place) -> list[str]:
        lines, start, axis = list[str](), 0, node.attributes["axis"]
        for part in node.inputs:
            index = indices(part.shape)
            target = place._replace(offset=start * place.strides[axis])
            lines += loops(part.shape, [f"{target.at(index)} = {self.load(part, index)};"])
            start += part.shape[axis]
        return lines

    def _take(self, node: Node, place: Place) -> list[str]:
        source, where = node.inputs
        axis, index = node.attributes["axis"], indices(node.shape)
        places = index[axis : axis + len(where.shape)]
        entry = [*index[:axis], self.load(where, places), *index[axis + len(where.shape) :]]
        return loops(node.shape, [f"{place.at(index)} = {self.load(source, entry)};"])

    def _gather(self, node: Node, place: Place) -> list[str]:
        source, where = node.inputs
        axis, index = node.attributes["axis"], indices(node.shape)
        entry = [*index[:axis], self.load(where, index), *index[axis + 1 :]]
        return loops(node.shape, [f"{place.at(index)} = {self.load(source, entry)};"])

    def _matmul(self, node: Node, place: Place) -> list[str]:
        """The innermost loop runs over what lies side by side."""
        left, right = node.inputs
        index, inner = indices(node.shape), left.shape[-1]
        *outer, i, j = index
        sizes = list(zip(index, node.shape, strict=True))
        if j == "0" and left.value is None:  # each row is a sum

            def product(named: Named) -> str:
                return f"{self.load(left, [*outer, i, named('k')])} * {self.load(right, [*outer, named('k'), j])}"

            return nested(sizes, total(place.at(index), [("k", inner)], product, "0.0f", "{0} += {1};"))
        load, times = self.load(left, [*outer, i, "k"]), self.load(right, [*outer, "k", j])
        if j == "0" and left.value is not None and left.value.ndim == 2:  # its columns
            load = self.constants.place(np.ascontiguousarray(left.value.T), "real").at(["k", i])
        sizes.insert(-2 if j == "0" else -1, ("k", inner))
        return [
            *loops(node.shape, [f"{place.at(index)} = 0.0f;"]),
            *nested(sizes, [f"{place.at(index)} += {load} * {times};"]),
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
        index = indices(below.shape)
        sizes = list(enumerate(zip(index, below.shape, strict=True)))
        kept, run = ([pair for axis, pair in sizes if (axis in axes) == among] for among in (False, True))
        target = place.at([i for i, _ in kept])
        return nested(kept, total(target, run, lambda named: self.load(below, [named(i) for i in index]), start, step))

    def _argmax(self, node: Node, place: Place) -> list[str]:
        (below,), (axis,) = node.inputs, node.attributes["axes"]
        index = indices(below.shape)
        kept = [i for k, i in enumerate(index) if k != axis]
        best = [place.at(kept) if k == axis else i for k, i in enumerate(index)]
        name, target = index[axis], place.at(kept)
        step = [f"if ({self.load(below, index)} > {self.load(below, best)}) {target} = {name};"]
        body = [f"{target} = 0;", *nested([(name, below.shape[axis])], step)]
        return nested([(i, below.shape[k]) for k, i in enumerate(index) if k != axis], body)

    def _sort(self, node: Node, place: Place) -> list[str]:
        """By insertion."""
        (below,), axis, index = node.inputs, node.attributes["axis"], indices(node.shape)
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
        return nested([*kept, (name, node.shape[axis])], body)

    def store(self, node: Node, array: str) -> None:
        """A statement that copies a node."""
        index = indices(node.shape)
        target = Place(array, 0, strides_of(node.shape))
        self.lines += loops(node.shape, [f"{target.at(index)} = {self.load(node, index)};"])


def split(nodes: Sequence[Node], name: str) -> tuple[list[Node], list[Node]]:
    """Nodes that do not depend on an input, and those that do."""
    apart = [[node for node in nodes if (name in node.needs) == depends] for depends in (False, True)]
    return apart[0], apart[1]
