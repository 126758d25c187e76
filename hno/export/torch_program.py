"""A graph as a program of torch, in the format of `torch.export`."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from typing import Any, final

import torch
from torch import Tensor, nn

from hno.export.graph import ELEMENTWISE, Kind, Node, Program, Shape, ordered
from hno.export.stages import parts

TYPES: dict[Kind, torch.dtype] = {"real": torch.float32, "int": torch.int64, "bool": torch.bool}
NAMES = {"and": "logical_and", "or": "logical_or", "not": "logical_not"}


def torch_files(program: Program, single: Program) -> dict[str, bytes]:
    """A program for each of the parts, from tensors to a tuple of tensors."""
    return {f"{name}.pt2": _program(*ends) for name, ends in parts(program, single).items()}


def _program(inputs: Mapping[str, Node], outputs: Mapping[str, Node]) -> bytes:
    batch = torch.export.Dim("batch")
    given = [torch.rand([size if size >= 0 else 3 for size in node.shape]) for node in inputs.values()]
    dynamic = tuple({0: batch} if node.shape[0] < 0 else {} for node in inputs.values())
    exported = torch.export.export(Controller(inputs, outputs), tuple(given), dynamic_shapes=(dynamic,))
    buffer = io.BytesIO()
    torch.export.save(exported, buffer)
    return buffer.getvalue()


@final
class Controller(nn.Module):
    """Operations from inputs to outputs, one after the other, with constants as buffers."""

    def __init__(self, inputs: Mapping[str, Node], outputs: Mapping[str, Node]) -> None:
        super().__init__()
        self.ends = list(inputs.values()), list(outputs.values())
        self.nodes = ordered(outputs.values(), inputs.values())
        for number, node in enumerate(self.nodes):
            if node.value is not None:
                self.register_buffer(f"constant{number}", torch.tensor(node.value, dtype=TYPES[node.kind]))

    def forward(self, *given: Tensor) -> tuple[Tensor, ...]:
        """Answers to the inputs."""
        found = dict(zip(self.ends[0], given, strict=True))
        for number, node in enumerate(self.nodes):
            if node.value is not None:
                found[node] = self.get_buffer(f"constant{number}")
            else:
                found[node] = _result(node, [found[below] for below in node.inputs], given[0].shape[0])
        return tuple(found[node] for node in self.ends[1])


def _result(node: Node, inputs: list[Tensor], batch: int) -> Tensor:
    if node.op == "cast":
        return inputs[0].to(TYPES[node.kind])
    if node.op in ELEMENTWISE:
        return getattr(torch, NAMES.get(node.op, node.op))(*inputs)
    return _OTHERS[node.op](node, node.attributes, _sizes(node.shape, batch), *inputs)


def _sizes(shape: Shape, batch: int) -> list[int]:
    return [size if size >= 0 else -size * batch for size in shape]


def _slice(node: Node, given: Mapping[str, Any], shape: list[int], x: Tensor) -> Tensor:
    return x[(*(slice(None),) * given["axis"], slice(given["start"], given["stop"], given["step"]))]


def _take(node: Node, given: Mapping[str, Any], shape: list[int], x: Tensor, index: Tensor) -> Tensor:
    return x.index_select(given["axis"], index.flatten()).reshape(shape)


def _prod(node: Node, given: Mapping[str, Any], shape: list[int], x: Tensor) -> Tensor:
    for axis in sorted(given["axes"], reverse=True):
        x = x.prod(axis)
    return x


_OTHERS: dict[str, Callable[..., Tensor]] = {
    "reshape": lambda node, given, shape, x: x.reshape(shape),
    "expand": lambda node, given, shape, x: x.expand(shape),
    "permute": lambda node, given, shape, x: x.permute(given["order"]),
    "slice": _slice,
    "cat": lambda node, given, shape, *parts: torch.cat(parts, given["axis"]),
    "take": _take,
    "gather": lambda node, given, shape, x, index: x.gather(given["axis"], index),
    "matmul": lambda node, given, shape, x, y: x @ y,
    "iota": lambda node, given, shape: torch.arange(shape[0]).reshape(shape),
    "sort": lambda node, given, shape, x: x.sort(given["axis"], given["descending"]).values,
    "sum": lambda node, given, shape, x: x.sum(given["axes"]),
    "prod": _prod,
    "max": lambda node, given, shape, x: x.amax(given["axes"]),
    "min": lambda node, given, shape, x: x.amin(given["axes"]),
    "argmax": lambda node, given, shape, x: x.argmax(given["axes"][0]),
}
