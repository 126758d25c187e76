"""The files of a controller in C."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from hno.export.c_loops import TYPES, Constants, Place, literal, strides_of
from hno.export.c_source import Body, split
from hno.export.graph import Node, Program, ordered
from hno.export.stages import stage
from hno.export.templates import filled
from hno.export.trace import state_limits
from hno.games import Box, Game
from hno.types import ROUNDING

NAMES = {"controller.h": "hno_controller.h", "controller.c": "hno_controller.c", "example.c": "example.c",
         "CMakeLists.txt": "CMakeLists.txt"}  # fmt: skip
MANY = "many."
"""What outputs for many types at one state begin with."""
HELPERS = {
    "larger": "static inline float larger(float a, float b) { return a > b ? a : b; }",
    "smaller": "static inline float smaller(float a, float b) { return a < b ? a : b; }",
    "wrapped": "static inline int wrapped(int a, int b) { return ((a % b) + b) % b; }",
}


def c_files(program: Program, game: Game, about: str) -> dict[str, str]:
    """File names and texts of a program of one state, whose outputs for many types have names with `MANY`."""
    constants = Constants()
    many = {name.removeprefix(MANY): node for name, node in program.outputs.items() if name.startswith(MANY)}
    one = {name: node for name, node in program.outputs.items() if not name.startswith(MANY)}
    early = stage(program.outputs.values(), frozenset(["theta"]))
    inputs = {node: _place(name, node) for name, node in program.inputs.items()}
    fields = {node: f"p{k}" for k, node in enumerate(early)}
    prepared = inputs | {node: _place(f"prepared->{name}", node) for node, name in fields.items()}
    body = Body(constants, inputs, early)
    body.compute(ordered(early, inputs))
    for node, name in fields.items():
        body.store(node, f"prepared->{name}")
    parts = {
        "PREPARE": body.lines,
        "CONTROL": _function(constants, prepared, {"out": one["control"]}),
        "EVERYTHING": _function(constants, prepared, {f"answer->{name}": node for name, node in one.items()}),
    }
    parts["MANY_SHARED"], parts["MANY_EACH"] = _many(constants, inputs, fields, many)
    low, high = state_limits(game)
    boxes = {"state_low": low, "state_high": high, "type_low": game.type_box.lo, "type_high": game.type_box.hi}
    lines = [_array(name, box) for name, box in boxes.items()]
    text = "\n".join(line for part in (*parts.values(), constants.lines) for line in part)
    margin = ROUNDING * game.horizon
    costate = one["costate"].shape
    words = {
        "ABOUT": about, "IDENTITY": hex(zlib.crc32(text.encode())), "FINGERPRINT": game.fingerprint(),
        "HORIZON": literal(game.horizon, "real"),
        "PLAYERS": costate[2], "STATES": costate[3], "FUNCTIONS": costate[1], "CONTROLS": one["control"].shape[2],
        "PREPARED": _fields({name: node for node, name in fields.items()}), "ANSWER": _fields(one),
        "HELPERS": "\n".join(code for name, code in HELPERS.items() if f"{name}(" in text),
        "CONSTANTS": "\n".join([*lines, *constants.lines]), "EARLIEST": literal(-margin, "real"),
        "LATEST": literal(game.horizon + margin, "real"), "PLAYERS_VALUE": "players" if "players" in one else "value",
        "THETA": _middle(game.type_box), "STATE": _middle(game.initial_box),
        **{name: _indented(code, 2 if name == "MANY_EACH" else 1) for name, code in parts.items()},
    }  # fmt: skip
    return {file: filled(name, words) for name, file in NAMES.items()}


def _place(array: str, node: Node) -> Place:
    return Place(array, 0, strides_of(node.shape))


def _function(constants: Constants, given: Mapping[Node, Place], outputs: Mapping[str, Node]) -> list[str]:
    body = Body(constants, given, outputs.values())
    body.compute(ordered(outputs.values(), given))
    for name, node in outputs.items():
        body.store(node, name)
    return ["const float tau[1] = {time};", "(void)prepared, (void)tau, (void)x;", *body.lines]


def _many(
    constants: Constants, inputs: Mapping[Node, Place], fields: Mapping[Node, str], outputs: Mapping[str, Node]
) -> tuple[list[str], list[str]]:
    """What all types share, and what is done for each."""
    given = {**inputs, **{node: _place(f"p->{name}", node) for node, name in fields.items()}}
    body = Body(constants, given, outputs.values())
    shared, each = split(ordered(outputs.values(), given), "theta")
    body.compute(shared)
    before, body.lines = ["const float tau[1] = {time};", "(void)tau;", *body.lines], []
    body.compute(each)
    found = {name: f"{name}_found" for name in outputs}
    for name, node in outputs.items():
        body.lines.append(f"float {found[name]}[{int(np.prod(node.shape))}];")
        body.store(node, found[name])
    size = int(np.prod(outputs["control"].shape))
    body.lines.append(f"if (!all_finite({found['control']}, {size})) return HNO_ERROR_NOT_FINITE;")
    for name, node in outputs.items():
        size, target = int(np.prod(node.shape)), "u" if name == "control" else name
        copy = f"memcpy({target} + t * {size}, {found[name]}, sizeof {found[name]})"
        body.lines.append(f"if ({target} != NULL) {copy};")
    return before, body.lines


def _fields(nodes: Mapping[str, Node]) -> str:
    return "\n".join(
        f"    {TYPES[node.kind]} {name}[{int(np.prod(node.shape))}]; /* {' x '.join(map(str, node.shape[1:])) or 1} */"
        for name, node in nodes.items()
    )


def _array(name: str, box: torch.Tensor) -> str:
    return f"static const float {name}[{box.numel()}] = {{{_listed(box)}}};"


def _listed(values: torch.Tensor) -> str:
    return ", ".join(literal(entry, "real") for entry in values.flatten().tolist())


def _middle(box: Box) -> str:
    return _listed((box.lo + box.hi) / 2)


def _indented(lines: Sequence[str], levels: int) -> str:
    return "\n".join("    " * levels + line for line in lines)
