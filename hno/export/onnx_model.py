"""A graph as an ONNX model of forward operations, with any batch."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, final

import numpy as np

from hno.export.graph import ELEMENTWISE, Kind, Node, Program, Shape, ordered
from hno.export.stages import parts

OPSET = 18
"""Version of the operators."""
IR = 9
"""Version of the file format that goes with it."""
NAMES = {
    "lt": "Less", "le": "LessOrEqual", "gt": "Greater", "ge": "GreaterOrEqual", "eq": "Equal", "maximum": "Max",
    "minimum": "Min", "asin": "Asin", "acos": "Acos", "atan": "Atan",
}  # fmt: skip
"""Where they are not the graph's with a capital."""
REDUCTIONS = {"sum": "ReduceSum", "prod": "ReduceProd", "max": "ReduceMax", "min": "ReduceMin"}
TYPES: dict[Kind, Any] = {"real": np.float32, "int": np.int64, "bool": np.bool_}


def onnx_files(program: Program, single: Program, about: Mapping[str, Any]) -> dict[str, bytes]:
    """A model for each of the parts."""
    return {f"{name}.onnx": _model(*ends, about) for name, ends in parts(program, single).items()}


def _model(inputs: Mapping[str, Node], outputs: Mapping[str, Node], about: Mapping[str, Any]) -> bytes:
    """A checked model, serialised."""
    import onnx

    graph = _Graph({node: name for name, node in inputs.items()})
    nodes = ordered(outputs.values(), inputs.values())
    for node in nodes:
        graph.add(node)
    for name, node in outputs.items():
        graph.call("Identity", [graph.names[node]], name)
    given, found = ([_info(name, node) for name, node in side.items()] for side in (inputs, outputs))
    made = onnx.helper.make_graph(graph.nodes, "controller", given, found, graph.constants)
    model = onnx.helper.make_model(
        made, opset_imports=[onnx.helper.make_opsetid("", OPSET)], ir_version=IR, producer_name="hno"
    )
    onnx.helper.set_model_props(model, {name: json.dumps(entry) for name, entry in about.items()})
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


def _info(name: str, node: Node) -> Any:
    from onnx import helper

    shape = [size if size >= 0 else "batch" if size == -1 else f"{-size} * batch" for size in node.shape]
    return helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(np.dtype(TYPES[node.kind])), shape)


@final
class _Graph:
    """Operations of a model under construction.

    Args:
        names: of nodes that are given.
    """

    def __init__(self, names: dict[Node, str]) -> None:
        self.names, self.nodes, self.constants = names, list[Any](), list[Any]()
        self._known: dict[Any, str] = {}

    def call(self, operation: str, inputs: Iterable[str], name: str | None = None, **attributes: Any) -> str:
        """Add an operation; its result's name."""
        from onnx import helper

        name = name or f"v{len(self.nodes)}"
        self.nodes.append(helper.make_node(operation, list(inputs), [name], **attributes))
        return name

    def constant(self, value: Any, kind: Kind = "int") -> str:
        """A constant's name."""
        from onnx import numpy_helper

        array = np.ascontiguousarray(value, TYPES[kind]).reshape(np.shape(value))
        key = kind, array.shape, array.tobytes()
        if key not in self._known:
            self._known[key] = name = f"c{len(self._known)}"
            self.constants.append(numpy_helper.from_array(array, name))
        return self._known[key]

    def add(self, node: Node) -> None:
        """Add a node whose operands are there."""
        if node in self.names:
            return
        inputs = [self.names[below] for below in node.inputs]
        if node.value is not None:
            self.names[node] = self.constant(node.value, node.kind)
        elif node.op in ELEMENTWISE:
            self.names[node] = self._elementwise(node, inputs)
        elif node.op in REDUCTIONS:
            axes = self.constant(list(node.attributes["axes"]))
            self.names[node] = self.call(REDUCTIONS[node.op], [*inputs, axes], keepdims=0)
        else:
            self.names[node] = getattr(self, f"_{node.op}")(node, inputs, **node.attributes)

    def _elementwise(self, node: Node, inputs: Sequence[str]) -> str:
        if node.op == "cast":
            from onnx import helper

            return self.call("Cast", inputs, to=helper.np_dtype_to_tensor_dtype(np.dtype(TYPES[node.kind])))
        if node.op == "ne":
            return self.call("Not", [self.call("Equal", inputs)])
        if node.op == "remainder" and node.kind == "int":
            return self.call("Mod", inputs)
        if node.op == "remainder":
            whole = self.call("Floor", [self.call("Div", inputs)])
            return self.call("Sub", [inputs[0], self.call("Mul", [inputs[1], whole])])
        return self.call(NAMES.get(node.op, node.op.capitalize()), inputs)

    def _sizes(self, shape: Shape) -> str:
        """A shape that may depend on the batch."""
        if all(size >= 0 for size in shape):
            return self.constant(list(shape))
        batch = self._known.get("batch") or self._known.setdefault("batch", self.call("Shape", ["tau"]))
        sizes = [
            self.constant([size]) if size >= 0 else self.call("Mul", [batch, self.constant([-size])]) for size in shape
        ]
        return self.call("Concat", sizes, axis=0)

    def _reshape(self, node: Node, inputs: Sequence[str]) -> str:
        return self.call("Reshape", [*inputs, self.constant([max(size, -1) for size in node.shape])])

    def _expand(self, node: Node, inputs: Sequence[str]) -> str:
        return self.call("Expand", [*inputs, self._sizes(node.shape)])

    def _permute(self, node: Node, inputs: Sequence[str], order: Sequence[int]) -> str:
        return self.call("Transpose", inputs, perm=order)

    def _slice(self, node: Node, inputs: Sequence[str], axis: int, start: int, stop: int, step: int) -> str:
        return self.call("Slice", [*inputs, *(self.constant([entry]) for entry in (start, stop, axis, step))])

    def _cat(self, node: Node, inputs: Sequence[str], axis: int) -> str:
        return self.call("Concat", inputs, axis=axis)

    def _take(self, node: Node, inputs: Sequence[str], axis: int) -> str:
        return self.call("Gather", inputs, axis=axis)

    def _gather(self, node: Node, inputs: Sequence[str], axis: int) -> str:
        return self.call("GatherElements", inputs, axis=axis)

    def _matmul(self, node: Node, inputs: Sequence[str]) -> str:
        return self.call("MatMul", inputs)

    def _argmax(self, node: Node, inputs: Sequence[str], axes: Sequence[int]) -> str:
        return self.call("ArgMax", inputs, axis=axes[0], keepdims=0)

    def _sort(self, node: Node, inputs: Sequence[str], axis: int, descending: bool) -> str:
        from onnx import helper

        values, count = f"v{len(self.nodes)}", self.constant([node.shape[axis]])
        made = helper.make_node(
            "TopK", [*inputs, count], [values, f"{values}_from"], axis=axis, largest=int(descending)
        )
        self.nodes.append(made)
        return values

    def _iota(self, node: Node, inputs: Sequence[str]) -> str:
        stop = self.call("Squeeze", [self._sizes(node.shape[:1])])
        counted = self.call("Range", [self.constant(0), stop, self.constant(1)])
        return self._reshape(node, [counted])
