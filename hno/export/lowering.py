"""From operations of torch (core aten) to those of a graph; an operation without a rule is refused."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import hno.export.views  # noqa: F401  # registers rules
from hno.export.graph import Builder, Node
from hno.export.rules import ELEMENTWISE, FREE, RULES, constant, elementwise

NAMED = ("alpha", "beta", "keepdim")
"""Arguments that are given by name and mean something; others are about memory."""


class UnsupportedError(ValueError):
    """A function with an operation that cannot be exported."""


def lowered(builder: Builder, name: str, result: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    """The node of a call of an operation, or a tuple of them.

    Args:
        builder: makes it.
        name: of the operation, such as "aten.add.Tensor".
        result: what it gave.
        args: nodes where it got tensors, and plain values.
        kwargs: likewise.

    Raises:
        UnsupportedError: it is not on the list; the message has its name.
    """
    kind = name.split(".")[1] if "." in name else name
    given = [node for arg in (*args, *kwargs.values()) for node in (arg if isinstance(arg, list) else [arg])]
    if kind in FREE or all(node.value is not None for node in given if isinstance(node, Node)):
        several = isinstance(result, (tuple, list))
        return tuple(constant(builder, part) for part in result) if several else constant(builder, result)
    try:
        if kind in ELEMENTWISE:
            return elementwise(builder, ELEMENTWISE[kind], result, *args)
        return RULES[kind](builder, result, *args, **{key: kwargs[key] for key in kwargs if key in NAMED})
    except (KeyError, NotImplementedError) as error:
        detail = f" {error}" if isinstance(error, NotImplementedError) else ""
        known = ", ".join(sorted({*RULES, *ELEMENTWISE, *FREE}))
        raise UnsupportedError(
            f"{name}{detail} cannot be exported. Write the game's sensors, terminal value and best response, or the "
            f"network, with other operations: {known}."
        ) from error
