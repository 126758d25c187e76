"""What can be computed once, and what is written as graphs of their own."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from hno.export.graph import Node, Program, ordered


def users(nodes: Iterable[Node]) -> Mapping[Node, list[Node]]:
    """Which nodes need each one."""
    found: dict[Node, list[Node]] = {}
    for node in nodes:
        for below in node.inputs:
            found.setdefault(below, []).append(node)
    return found


def stage(outputs: Iterable[Node], early: frozenset[str]) -> list[Node]:
    """What depends on the early inputs alone and is needed by anything else: it can be computed once.

    A batch stands first in each of them, if it has one.
    """
    ends = list(outputs)
    nodes = ordered(ends)

    def first(node: Node) -> bool:
        return bool(node.needs) and node.needs <= early

    def cuts(node: Node) -> Iterator[Node]:
        if all(size >= 0 for size in node.shape[1:]) and node.op not in ("input", "reshape", "expand"):
            yield node
        else:
            yield from (
                (node,) if node.op == "input" else (cut for below in node.inputs if below.needs for cut in cuts(below))
            )

    later = [node for node in nodes if not first(node)]
    edges = [below for node in later for below in node.inputs if first(below)] + [end for end in ends if first(end)]
    return list(dict.fromkeys(cut for edge in edges for cut in cuts(edge)))


def parts(program: Program, single: Program) -> dict[str, tuple[dict[str, Node], dict[str, Node]]]:
    """Inputs and outputs of what is written as separate graphs, by name.

    Everything for any batch, and two halves for one state: what types determine, and controls.
    """
    early = stage([single.outputs["control"]], frozenset(["theta"]))
    prepared = {f"prepared{k}": node for k, node in enumerate(early)}
    state = {name: single.inputs[name] for name in ("tau", "x")}
    return {
        "controller": (program.inputs, program.outputs),
        "prepare": ({"theta": single.inputs["theta"]}, prepared),
        "control": ({**prepared, **state}, {"control": single.outputs["control"]}),
    }
