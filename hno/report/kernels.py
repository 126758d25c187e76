"""Condition numbers of the tangent kernel by activation, and their ratios (the paper's table of activations)."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from hno.evaluation.spectrum import Ratio, Summary, condition_ratio
from hno.report.parsing import UnreadableError, number, records, types, whole
from hno.report.runs import NOT_AVAILABLE, Run
from hno.report.tables import Cell, Row, Table
from hno.report.words import theta

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
    kind: str


Line = tuple[str, Mapping[str, Summary]]
"""Name of the run that a line is about, empty where there is one for every activation; spectra by activation."""


def condition_table(runs: Sequence[Run]) -> Table:
    """One line for every game, operator, training seed, type, size and kind of kernel.

    Where several runs share all of that and the activation, each has a line of its own, beside activations of one run.
    """
    found: dict[Key, dict[str, list[tuple[str, Summary]]]] = defaultdict(lambda: defaultdict(list))
    for run in runs:
        for entry in records(run.content.get("ntk")):
            for key, spectrum in _spectra(run, entry):
                found[key][run.activation].append((run.name, spectrum))
    lines = [(key, line) for key in sorted(found) for line in _lines(found[key])]
    names = sorted({name for _, (_, spectra) in lines for name in spectra})
    others = [name for name in names if name != REFERENCE] if REFERENCE in names else []
    columns = ["game", "operator", "seed", "types", "points", "rows", "kernel", "run"]
    columns += [*names, *(f"{REFERENCE} / {name}" for name in others)]
    return Table(columns, [Row(_cells(key, line, names, others)) for key, line in lines])


def _lines(found: Mapping[str, Sequence[tuple[str, Summary]]]) -> list[Line]:
    single = {name: entries[0][1] for name, entries in found.items() if len(entries) == 1}
    several = {name: entries for name, entries in found.items() if len(entries) > 1}
    lines: list[Line] = [
        (run, {**single, name: spectrum}) for name, entries in several.items() for run, spectrum in entries
    ]
    return lines or [("", single)]


def _spectra(run: Run, entry: Mapping[str, Any]) -> list[tuple[Key, Summary]]:
    try:
        at = types(entry.get("theta"))
    except UnreadableError:
        return []
    seed, points = NOT_AVAILABLE if run.seed is None else str(run.seed), whole(entry.get("points")) or 0
    known = [(kind, _sound(entry.get(kind))) for kind in KINDS]
    return [(Key(run.game, run.operator, seed, at, points, s["rows"], kind), s) for kind, s in known if s is not None]


def _sound(found: Any) -> Summary | None:
    """What `condition_ratio` needs of a spectrum; None where that is missing."""
    if not isinstance(found, dict):
        return None
    sound = {name: number(found.get(name)) for name in ("condition", "cutoff")}
    sound |= {name: whole(found.get(name)) for name in ("rank", "rows")}
    return sound if all(sound.values()) else None


def _cells(key: Key, line: Line, names: Sequence[str], others: Sequence[str]) -> list[Cell]:
    run, spectra = line
    known = [key.game, key.operator, key.seed, theta(key.types), str(key.points), str(key.rows), KINDS[key.kind], run]
    values = [_value(spectra[name]) if name in spectra else NOT_AVAILABLE for name in names]
    ratios = [
        _ratio(condition_ratio(spectra[REFERENCE], spectra[name]))
        if {REFERENCE, name} <= set(spectra)
        else NOT_AVAILABLE
        for name in others
    ]
    return [Cell(text) for text in (*known, *values, *ratios)]


def _value(found: Summary) -> str:
    whole_rank = found["rank"] == found["rows"]
    return f"{found['condition']:.3g}" if whole_rank else f"> {1 / found['cutoff']:.3g}"


def _ratio(found: Ratio) -> str:
    if found.value is None:
        return NOT_AVAILABLE
    return f"{found.value:.3g}" if found.bound == "=" else f"{found.bound} {found.value:.3g}"
