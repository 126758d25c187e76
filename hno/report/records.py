"""What results.json and csv/metrics.csv hold, as typed records."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, SkipValidation, TypeAdapter, ValidationError

from hno.evaluation.closed_loop import TypeRow
from hno.evaluation.format import NOT_AVAILABLE
from hno.evaluation.outcome import Outcome
from hno.report.episode import Episode

T = TypeVar("T")
Curves = dict[str, list[tuple[int, float]]]
"""Metric -> step and value."""
PLAY = ("clearance", "dt", "widen", "noise", "delay")
"""Fields of `Run` that say how episodes were played; their defaults go without saying."""


class UnreadableError(ValueError):
    """A file that is not what it should be; the message says what is wrong with it."""


class Run(BaseModel):
    """One model: what results.json says of it, and what lies beside that file. Other entries are kept as they are."""

    model_config = ConfigDict(frozen=True, strict=True, extra="allow", allow_inf_nan=False)

    status: str
    reason: str | None = None
    """Why it failed."""
    game: str = NOT_AVAILABLE
    operator: str = NOT_AVAILABLE
    activation: str = NOT_AVAILABLE
    seed: int | None = None
    steps: int | None = None
    checkpoint: str | None = None
    seconds: dict[str, float] = {}
    metrics: dict[str, float | None] = {}
    versions: dict[str, str] = {}
    label_statistics: list[dict[str, Any]] = []
    config: dict[str, Any] | None = None
    clearance: float = 0.02
    constraint_unit: str = "m"
    dt: float = 0.02
    widen: float = 1
    noise: float = 0
    delay: int = 0
    test_seed: int | None = None
    table: SkipValidation[list[TypeRow]]
    """One row for every type."""

    name: str = ""
    """Its folder, relative to the one that was asked for."""
    settings: SkipValidation[dict[str, str]] = {}
    """The configuration, dotted names."""
    curves: SkipValidation[Curves] = {}
    episodes: SkipValidation[list[Episode]] = []
    command: SkipValidation[str | None] = None
    """The command line that repeats it."""
    notes: SkipValidation[list[str]] = []
    """What could not be read, and why."""

    @property
    def finished(self) -> bool:
        """Whether it came to its end without failing."""
        return self.status == "finished"

    @property
    def conditions(self) -> str:
        """How episodes were played, as far as that is special: equal for runs that may be compared."""
        found = {name: (getattr(self, name), type(self).model_fields[name].default) for name in PLAY}
        return ", ".join(f"{name} {value:g}" for name, (value, usual) in found.items() if value != usual)

    @property
    def entries(self) -> Mapping[str, Any]:
        """Entries of results.json that have no field, such as sections of an evaluation."""
        return self.model_extra or {}


_ROW = TypeAdapter(TypeRow, config=ConfigDict(strict=True, allow_inf_nan=False))


def read_results(path: Path) -> list[dict[str, Any]]:
    """The models of a results.json, each as if it were alone in its file.

    Raises:
        UnreadableError: it is missing, no JSON, or no results of hno.
    """
    content = read_json(path)
    if not isinstance(content, dict):
        raise UnreadableError(f"{path.name} is not hno's: expected an object, got a {type(content).__name__}")
    models = content.pop("models", None) or [{}]
    shared = {key: value for key, value in content.items() if key not in ("episodes", "comparison")}
    return [{**content, **models[0]}, *({**shared, **model} for model in models[1:])]


def read_json(path: Path) -> Any:
    """Content of a JSON file.

    Raises:
        UnreadableError: it is missing, or no JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UnreadableError(f"{path.name} cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise UnreadableError(f"{path.name} is not JSON ({error})") from error


def run_of(content: Mapping[str, Any], file: str) -> Run:
    """The record of a model, with its rows and remarks about those that are left out.

    Raises:
        UnreadableError: an entry is not what it should be.
    """
    try:
        run = Run.model_validate_json(json.dumps(content))
    except ValidationError as error:
        raise UnreadableError(f"{file} is not hno's: {sentence(error)}") from error
    table, notes = each(run.table, type_row, "row of the table")
    return run.model_copy(update={"table": table, "notes": notes})


def type_row(content: Any) -> TypeRow:
    """A row of the collision table from its entry of results.json.

    Raises:
        ValueError: entries are missing, of the wrong type, or contradict each other.
    """
    if not isinstance(content, dict):
        raise ValueError(f"expected an object, got {content!r:.60}")
    nested = {key: content[key] for key in TypeRow._fields if key in content}
    nested["outcome"] = {key: content[key] for key in Outcome._fields if key in content}
    row = _ROW.validate_json(json.dumps(nested))
    if not 0 <= row.outcome.collisions <= row.outcome.safe_starts:
        raise ValueError(f"{row.outcome.collisions} collisions of {row.outcome.safe_starts} safe starts")
    return row


def each(entries: Any, read: Callable[[Any], T], what: str) -> tuple[list[T], list[str]]:
    """Records of a list, and remarks about its entries that are none."""
    if not isinstance(entries, list):
        return [], [f"expected a list of each {what}; got {entries!r:.60}"]
    found, notes = list[T](), list[str]()
    for entry in entries:
        try:
            found.append(read(entry))
        except ValueError as error:
            said = sentence(error) if isinstance(error, ValidationError) else error
            notes.append(f"a {what} is left out: {said}")
    return found, notes


def sentence(error: ValidationError) -> str:
    """The first thing that is wrong."""
    first = error.errors()[0]
    place = ".".join(str(step) for step in first["loc"]) or "content"
    found = "" if first["type"] == "missing" else f", got {first['input']!r:.60}"
    return f"{place}: {first['msg'][0].lower()}{first['msg'][1:]}{found}"


def curves(path: Path) -> Curves:
    """Metrics of a CSV file by step; lines that are cut off are left out.

    Raises:
        UnreadableError: no CSV file with a column "step".
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            lines = csv.DictReader(file)
            if "step" not in (lines.fieldnames or ()):
                raise UnreadableError(f"{path.name} has no column 'step'")
            return _by_metric(lines)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UnreadableError(f"{path.name} cannot be read ({error})") from error


def _by_metric(lines: Iterable[Mapping[str | Any, str | Any]]) -> Curves:
    found: Curves = {}
    for line in lines:
        step = _decimal(line["step"])
        for name, text in line.items():
            value = _decimal(text)
            if isinstance(name, str) and name not in ("step", "epoch") and step is not None and value is not None:
                found.setdefault(name, []).append((int(step), value))
    return found


def _decimal(text: Any) -> float | None:
    try:
        value = float(text)
    except (TypeError, ValueError):
        return None
    return value if math.isfinite(value) else None
