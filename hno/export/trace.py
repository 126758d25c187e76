"""From an operator to the graph of its value, its derivatives and its controls."""

from __future__ import annotations

import copy
import operator
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, fx
from torch._decomp import core_aten_decompositions
from torch.func import functionalize, jacfwd
from torch.fx.experimental.proxy_tensor import make_fx

from hno.export.batch import BatchError, unified
from hno.export.graph import Builder, Program
from hno.export.lowering import UnsupportedError, lowered
from hno.export.rules import constant
from hno.games import Game
from hno.operators.base import ValueOperator
from hno.types import ROUNDING, Points, Types

SIZES = 5, 7
"""Batches that are traced to learn what depends on their size."""
INPUTS = "tau", "x", "theta"
Traced = Callable[[Tensor, Tensor, Tensor], dict[str, Tensor]]


def in_double(learned: ValueOperator) -> ValueOperator:
    """A copy in double precision, without gradients."""
    return copy.deepcopy(learned).cpu().double().eval().requires_grad_(False)


def answers(learned: ValueOperator) -> Traced:
    """Everything that the operator says of states, each with types of its own: its field and the controls."""

    def found(tau: Tensor, x: Tensor, theta: Tensor) -> dict[str, Tensor]:
        field = learned.field(Points(tau, x, theta), Types(theta, torch.arange(len(tau), device=x.device)))
        return {**field._asdict(), "control": learned.problem.optimal_control(x, field.costate)}

    return found


def answers_at_one_state(learned: ValueOperator) -> Traced:
    """V_i, costates and controls of a batch of one, by derivatives that run forward.

    What does not depend on the types is apart then.
    """
    learned = copy.copy(learned)
    learned.jacobian = jacfwd

    def found(tau: Tensor, x: Tensor, theta: Tensor) -> dict[str, Tensor]:
        value, costate = learned.value_and_costate(tau[0], x[0], theta[0])
        control = learned.problem.optimal_control(x, costate.unsqueeze(0))
        return {"value": value.unsqueeze(0), "costate": costate.unsqueeze(0), "control": control}

    return found


def for_any_batch(learned: ValueOperator) -> Program:
    """`answers` as a graph of any batch.

    Raises:
        UnsupportedError: an operation of the game or the network is not on the list, see `hno.export.lowering`.
    """
    try:
        few, more = (traced(answers(learned), learned.game, size) for size in SIZES)
        return unified(few, more, SIZES)
    except BatchError as error:
        raise UnsupportedError(f"The operator cannot be exported for any batch: {error}.") from error


def points(game: Game, size: int, seed: int, widen: float = 1.0) -> dict[str, Tensor]:
    """Random questions within the horizon, the PDE box and the type box, in single precision as numbers of double."""
    generator = torch.Generator().manual_seed(seed)
    boxes = copy.deepcopy(game).cpu().float()
    tau = boxes.horizon * torch.rand(size, generator=generator)
    x, theta = boxes.state_box.widened(widen).sample(size, generator), boxes.type_box.sample(size, generator)
    return {"tau": tau.double(), "x": x.double(), "theta": theta.double()}


def state_limits(game: Game) -> tuple[Tensor, Tensor]:
    """Ends of the PDE box with room for rounding, (P, n); states that wrap around have none."""
    box = game.state_box.widened(1 + 2 * ROUNDING)
    low, high = box.lo.clone(), box.hi.clone()
    low[..., list(game.periodic)], high[..., list(game.periodic)] = -torch.inf, torch.inf
    return low, high


def traced(function: Traced, game: Game, size: int) -> Program:
    """The graph of a function of (tau, x, theta) for a batch of one size. Raises as `for_any_batch`."""
    given = points(game, size, 0)
    table: Any = core_aten_decompositions()
    with warnings.catch_warnings(action="ignore"), torch.enable_grad():
        first = make_fx(function)(*given.values())
        plain = make_fx(functionalize(first), decomposition_table=table)(*given.values())
    plain.graph.eliminate_dead_code()
    return _program(plain, given)


def _program(module: fx.GraphModule, given: Mapping[str, Tensor]) -> Program:
    builder = Builder()
    inputs = {name: builder.input(name, value.shape) for name, value in given.items()}
    waiting = list(given)
    values, nodes = dict[fx.Node, Any](), dict[fx.Node, Any]()
    for node in module.graph.nodes:
        if node.op == "placeholder":
            name = waiting.pop(0)
            values[node], nodes[node] = given[name], inputs[name]
        elif node.op == "get_attr":
            values[node] = getattr(module, node.target)
            nodes[node] = constant(builder, values[node])
        elif node.op == "output":
            return Program(inputs, fx.node.map_arg(node.args[0], nodes.__getitem__))
        else:
            values[node], nodes[node] = _called(builder, node, values, nodes)
    raise AssertionError("a graph ends in its output")


def _called(builder: Builder, node: fx.Node, values: dict[fx.Node, Any], nodes: dict[fx.Node, Any]) -> tuple[Any, Any]:
    """What an operation gives, and its node or nodes."""
    args: Any = fx.node.map_arg(node.args, values.__getitem__)
    function: Any = node.target
    result = function(*args, **fx.node.map_arg(node.kwargs, values.__getitem__))
    given: Any = fx.node.map_arg(node.args, nodes.__getitem__)
    if function is operator.getitem:
        return result, given[0][given[1]]
    lists = [list(arg) if isinstance(arg, (list, tuple)) else arg for arg in given]
    return result, lowered(builder, str(function), result, lists, dict(node.kwargs))
