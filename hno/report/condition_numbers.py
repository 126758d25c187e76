"""Condition numbers of the tangent kernel by activation, and their ratios (the paper's table of activations)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from hno.evaluation.format import NOT_AVAILABLE, significant
from hno.evaluation.sections import Column, plain
from hno.evaluation.spectrum import Ratio, Summary, condition_ratio
from hno.report.records import Run
from hno.report.tables import Row, Table
from hno.report.verdicts import at

KINDS = {"kernel": "J J'", "product": "trunk times branch"}
"""Kernels of a section `ntk`: over all parameters, and the paper's definition."""
REFERENCE = "tanh"
"""The activation whose condition number is divided by those of the others."""


class Key(NamedTuple):
    """What kernels share that may be compared."""

    game: str
    operator: str
    seed: str
    """Of the training."""
    types: tuple[float, ...]
    points: int
    rows: int
    kernel: str


Line = tuple[str, dict[str, Summary]]
"""Name of the run that a line is about, empty where there is one for every activation; kernels by activation."""


def condition_table(runs: Sequence[Run]) -> Table:
    """One line for every game, operator, training seed, type, size and kind of kernel.

    Where several runs share all of that and the activation, each has a line of its own, beside activations of one run.
    """
    found: dict[Key, dict[str, dict[str, Summary]]] = {}
    for run in runs:
        for key, kernel in _kernels(run):
            found.setdefault(key, {}).setdefault(run.activation, {})[run.name] = kernel
    lines = [(key, line) for key in sorted(found) for line in _lines(found[key])]
    names = sorted({name for _, (_, kernels) in lines for name in kernels})
    others = [name for name in names if name != REFERENCE] if REFERENCE in names else []
    columns = [Column(name, name) for name in (*Key._fields, "run", *names)]
    columns += [Column(f"{REFERENCE} / {name}", f"{REFERENCE} / {name}") for name in others]
    return Table(columns, [Row(_values(key, line, others)) for key, line in lines])


def _kernels(run: Run) -> Iterator[tuple[Key, Summary]]:
    """Kernels of a run, without those of zeros and without damaged entries."""
    seed = plain(run.seed)
    for entry in run.entries.get("ntk") or []:
        for kind, name in KINDS.items():
            try:
                kernel, types = entry[kind], tuple(map(float, entry["theta"]))
                known = [kernel[field] for field in ("condition", "cutoff", "rank", "rows")]
                key = Key(run.game, run.operator, seed, types, int(entry["points"]), kernel["rows"], name)
            except (KeyError, TypeError, ValueError):
                continue
            if all(known):
                yield key, kernel


def _lines(found: Mapping[str, Mapping[str, Summary]]) -> list[Line]:
    single = {name: next(iter(runs.values())) for name, runs in found.items() if len(runs) == 1}
    several: list[Line] = [
        (run, {**single, name: kernel}) for name, runs in found.items() if len(runs) > 1 for run, kernel in runs.items()
    ]
    return several or [("", single)]


def _values(key: Key, line: Line, others: Sequence[str]) -> dict[str, Any]:
    run, kernels = line
    ratios = {f"{REFERENCE} / {name}": _ratio(kernels.get(REFERENCE), kernels.get(name)) for name in others}
    known = {name: str(value) for name, value in key._asdict().items()} | {"types": at(key.types), "run": run}
    return {**known, **{name: _condition(kernel) for name, kernel in kernels.items()}, **ratios}


def _condition(found: Summary) -> str:
    return significant(found["condition"]) if found["rank"] == found["rows"] else f"> {1 / found['cutoff']:.3g}"


def _ratio(over: Summary | None, under: Summary | None) -> str:
    found = Ratio(None, "n/a") if over is None or under is None else condition_ratio(over, under)
    bound = "" if found.bound == "=" else f"{found.bound} "
    return NOT_AVAILABLE if found.value is None else f"{bound}{significant(found.value)}"
