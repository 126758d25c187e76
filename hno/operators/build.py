"""From registered names and plain options to operators, and back for checkpoints."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from hno.games import Game
from hno.operators.activations import activations
from hno.operators.base import ValueOperator, functions
from hno.operators.network import networks
from hno.registry import check_options


@dataclass(frozen=True)
class Choice:
    """A registered name and options of its constructor, plain containers."""

    name: str
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Architecture:
    """What an operator is built of."""

    function: Choice = Choice("value")
    network: Choice = Choice("deeponet")
    activation: Choice = Choice("sin")


def make_operator(game: Game, architecture: Architecture = Architecture()) -> ValueOperator:
    """An operator of registered parts, with random weights.

    Raises:
        UnknownNameError: a part is not registered, or does not know an option.
        ValueError: an option that makes no sense, see the part.
    """
    function, network, activation = architecture.function, architecture.network, architecture.activation
    make_activation = activations.get(activation.name)
    check_options(f"activation {activation.name}", make_activation, activation.options)
    make_network = networks.get(network.name)
    check_options(f"network {network.name}", make_network, network.options, skip=("inputs", "activation"))
    cls = functions.get(function.name)
    check_options(f"function {function.name}", cls, function.options, skip=("game", "network"))
    parts = functools.partial(make_activation, **activation.options)
    return cls(game, functools.partial(make_network, activation=parts, **network.options), **function.options)
