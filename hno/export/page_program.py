"""A graph as JSON that the page of a report evaluates (`hno/report/assets/graph.js`)."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hno.export.batch import unified
from hno.export.graph import Node, Program, ordered
from hno.export.trace import SIZES, Traced, in_double, traced
from hno.operators.base import ValueOperator
from hno.types import Points, PotentialField, Types

SMALL = 100
"""Constants of so many entries are written in full precision; larger ones are weights, in half precision."""
PUSH = 0.1
"""Part of the horizon over which controls push, see `answers_of_one_type`."""


def answers_of_one_type(learned: ValueOperator) -> Traced:
    """What a slice shows of states that all have the types of the first one.

    Besides values, costates, controls and constraints it is the push: by how much the controls, held for `PUSH` of the
    horizon, move the states compared with those that cost least, (B, P, n), by two Euler steps.
    """
    game = learned.game

    def found(tau: Tensor, x: Tensor, theta: Tensor) -> dict[str, Tensor]:
        # zeros that depend on tau: as a constant, what follows from them would depend on the size of the batch
        table = Types(theta[:1], (0 * tau).long())
        field = learned.field(Points(tau, x, theta), table)
        control, rest = (
            learned.problem.optimal_control(x, costate) for costate in (field.costate, torch.zeros_like(field.costate))
        )
        half = PUSH * game.horizon / 2

        def moved(u: Tensor) -> Tensor:
            middle = x + half * game.dynamics(x, u)
            return middle + half * game.dynamics(middle, u)

        values = {"value": field.value}
        if isinstance(field, PotentialField):
            values = {"value": field.players, "potential": field.value.squeeze(-1)}
        return {
            **values, "costate": field.costate, "control": control, "constraint": game.constraint(x, theta),
            "push": moved(control) - moved(rest),
        }  # fmt: skip

    return found


def page_program(learned: ValueOperator) -> dict[str, Any]:
    """The graph of `answers_of_one_type` for any batch, as JSON content.

    Raises:
        UnsupportedError, BatchError: an operation of the game or the network cannot be written.
    """
    function, game = answers_of_one_type(in_double(learned)), learned.game
    few, more = (traced(function, game, size) for size in SIZES)
    return as_json(unified(few, more, SIZES))


def as_json(program: Program) -> dict[str, Any]:
    """Nodes, each after those that it needs, and which of them the outputs are."""
    nodes = ordered(program.outputs.values())
    place = {node: k for k, node in enumerate(nodes)}
    return {
        "nodes": [_node(node, [place[below] for below in node.inputs]) for node in nodes],
        "outputs": {name: place[node] for name, node in program.outputs.items()},
    }


def _node(node: Node, inputs: list[int]) -> dict[str, Any]:
    found = {"op": node.op, "inputs": inputs, "shape": list(node.shape), "kind": node.kind, **node.attributes}
    return found if node.value is None else {**found, **_constant(node.value)}


def _constant(value: NDArray[Any]) -> dict[str, Any]:
    """Numbers, as text where JSON has none; or halves, little-endian in base64, of the largest one."""
    if value.size <= SMALL or value.dtype.kind != "f":
        words = {np.inf: "Infinity", -np.inf: "-Infinity"}
        return {"values": [one if np.isfinite(one) else words.get(one, "NaN") for one in value.ravel().tolist()]}
    largest = float(np.abs(value).max()) or 1.0
    halves = (value / largest).astype("<f2")
    return {"halves": base64.b64encode(halves.tobytes()).decode(), "largest": largest}
