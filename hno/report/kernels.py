"""Condition numbers of the tangent kernel by activation, and their ratios (the paper's table of activations)."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from hno.report.parsing import UnreadableError, number, records, types, whole
from hno.report.runs import NOT_AVAILABLE, Run
from hno.report.tables import Cell, Row, Table
from hno.report.words import theta

KINDS = {"kernel": "J J'", "product": "trunk times branch"}
"""Kernels of a section `ntk`: over all parameters, and the paper's definition."""
REFERENCE = "tanh"
"""The activation whose condition number is divided by those of the others."""


class Condition(NamedTuple):
    """A condition number; where the matrix is cut off, a lower bound of it."""

    value: float
    exact: bool

    @property
    def text(self) -> str:
        """As it is written."""
        return f"{'' if self.exact else '> '}{self.value:.3g}"


Key = tuple[str, str, str, tuple[float, ...], str]
"""Game, operator, training seed, types, kind of kernel."""


def condition_table(runs: Sequence[Run]) -> Table:
    """One line for every game, operator, training seed, type and kind of kernel."""
    found: dict[Key, dict[str, Condition]] = defaultdict(dict)
    for run in runs:
        for entry in records(run.content.get("ntk")):
            for key, condition in _conditions(run, entry):
                found[key][run.activation] = condition
    names = sorted({name for conditions in found.values() for name in conditions})
    others = [name for name in names if name != REFERENCE] if REFERENCE in names else []
    columns = ["game", "operator", "seed", "types", "kernel", *names, *(f"{REFERENCE} / {name}" for name in others)]
    return Table(columns, [Row(_cells(key, found[key], names, others)) for key in sorted(found)])


def _conditions(run: Run, entry: Mapping[str, Any]) -> list[tuple[Key, Condition]]:
    try:
        at = types(entry.get("theta"))
    except UnreadableError:
        return []
    seed = NOT_AVAILABLE if run.seed is None else str(run.seed)
    known = [(kind, _condition(entry.get(kind))) for kind in KINDS]
    return [((run.game, run.operator, seed, at, kind), one) for kind, one in known if one is not None]


def _condition(found: Any) -> Condition | None:
    if not isinstance(found, dict):
        return None
    value, cutoff = number(found.get("condition")), number(found.get("cutoff"))
    rank, rows = whole(found.get("rank")), whole(found.get("rows"))
    if value is None or rank is None or rows is None:
        return None
    if rank == rows:
        return Condition(value, True)
    return Condition(1 / cutoff, False) if cutoff else None


def _cells(key: Key, found: Mapping[str, Condition], names: Sequence[str], others: Sequence[str]) -> list[Cell]:
    game, operator, seed, at, kind = key
    values = [Cell(found[name].text) if name in found else Cell(NOT_AVAILABLE) for name in names]
    ratios = [Cell(ratio(found.get(REFERENCE), found.get(name))) for name in others]
    return [Cell(game), Cell(operator), Cell(seed), Cell(theta(at)), Cell(KINDS[kind]), *values, *ratios]


def ratio(over: Condition | None, under: Condition | None) -> str:
    """A ratio of condition numbers, or a bound where one of them is one; "n/a" where both are."""
    if over is None or under is None or not (over.exact or under.exact):
        return NOT_AVAILABLE
    sign = "" if over.exact and under.exact else ("< " if over.exact else "> ")
    return f"{sign}{over.value / under.value:.3g}"
