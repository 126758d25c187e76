"""Folders of runs and sweeps, as train.py and evaluate.py leave them."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from hno.report.hydra_files import command_of, read_yaml, sweep_of
from hno.report.parsing import (
    Curves,
    Episode,
    TypeResult,
    UnreadableError,
    curves,
    episode,
    flatten,
    read_json,
    records,
    type_result,
    whole,
)

T = TypeVar("T")

RESULTS = "results.json"
METRICS = "csv/metrics.csv"
EPISODES = "episodes.json"
SCHEMAS = (1, 2)
"""Versions of results.json that are known."""
ENDED = ("finished", "failed")
"""States of a job that has ended; any other is unfinished."""
NOT_AVAILABLE = "n/a"
CONDITIONS = {"clearance": 0.02, "dt": 0.02, "widen": 1, "noise": 0, "delay": 0}
"""Entries of results.json that say how episodes were played, with the usual values, which go without saying."""


class NoRunsError(ValueError):
    """A folder that holds no run."""


class Run(NamedTuple):
    """One job."""

    name: str
    """Its folder, relative to the one that was asked for."""
    status: str
    reason: str | None
    """Why it failed."""
    game: str
    operator: str
    activation: str
    seed: int | None
    content: Mapping[str, Any]
    """Everything in results.json."""
    table: tuple[TypeResult, ...]
    settings: Mapping[str, str]
    """The configuration, dotted names."""
    curves: Curves
    episodes: tuple[Episode, ...]
    command: str | None
    """The command line that repeats it."""
    notes: tuple[str, ...]
    """What could not be read, and why."""

    @property
    def finished(self) -> bool:
        """Whether it came to its end without failing."""
        return self.status == "finished"

    @property
    def conditions(self) -> str:
        """How episodes were played, as far as that is special: equal for runs that may be compared."""
        found = {name: self.content.get(name, usual) for name, usual in CONDITIONS.items()}
        return ", ".join(f"{name} {value}" for name, value in found.items() if value != CONDITIONS[name])


class Skipped(NamedTuple):
    """A folder that looks like a run and is none."""

    name: str
    reason: str


class Sweep(NamedTuple):
    """All runs below a folder."""

    name: str
    runs: tuple[Run, ...]
    skipped: tuple[Skipped, ...]
    command: str | None
    """The command line of the whole sweep; None for single runs."""
    planned: int | None
    """How many jobs it has; None where that is not known."""


def load(root: Path) -> Sweep:
    """Read all runs in a folder and below.

    Raises:
        NoRunsError: there is none.
    """
    if not root.is_dir():
        raise NoRunsError(
            f"{root} is not a folder. Give the folder of a run or of a sweep, such as multirun/<date>/<time>."
        )
    runs, skipped = [], []
    for folder in _candidates(root):
        name = root.resolve().name if folder == root else folder.relative_to(root).as_posix()
        try:
            runs += _unchanged(folder, name, _stamp(folder))
        except UnreadableError as error:
            skipped.append(Skipped(name, str(error)))
    if not runs:
        found = "; ".join(f"{entry.name}: {entry.reason}" for entry in skipped[:3]) or f"no {RESULTS} in it or below"
        raise NoRunsError(f"{root} holds no run ({found}). Runs are written by train.py and evaluate.py.")
    command, planned = sweep_of(root / "multirun.yaml")
    return Sweep(root.resolve().name, tuple(runs), tuple(skipped), command, planned)


def _candidates(root: Path) -> list[Path]:
    """Folders with results, and those where Hydra began a job."""
    marks = [*root.rglob(RESULTS), *root.rglob(".hydra")]
    return sorted({mark.parent for mark in marks}, key=_natural)


def _natural(path: Path) -> list[tuple[float, str]]:
    """Sorts 2_drone before 10_drone."""
    heads = [(part.split("_")[0], part) for part in path.parts]
    return [(float(head) if head.isdecimal() else math.inf, part) for head, part in heads]


def _stamp(folder: Path) -> tuple[int, ...]:
    """Changes whenever something that is read does."""
    paths = (folder / name for name in (RESULTS, METRICS, EPISODES))
    return tuple(path.stat().st_mtime_ns if path.exists() else 0 for path in paths)


@functools.lru_cache(maxsize=1000)
def _unchanged(folder: Path, name: str, stamp: tuple[int, ...]) -> list[Run]:
    """Runs of a folder that has not changed since are not read again."""
    return read_runs(folder, name)


def read_runs(folder: Path, name: str) -> list[Run]:
    """The run of a folder, or one for each model of an evaluation; parts that cannot be read are left out and noted.

    Raises:
        UnreadableError: it has no results, or foreign ones.
    """
    content = _results(folder)
    models = records(content.get("models"))
    if len(models) < 2:
        return [_run(folder, name, content)]
    rest = {key: value for key, value in content.items() if key not in ("models", "episodes", "comparison")}
    first = {**content, **models[0]}
    contents = [first, *({**rest, **model} for model in models[1:])]
    return [_run(folder, f"{name} [{k}]", one) for k, one in enumerate(contents)]


def _results(folder: Path) -> dict[str, Any]:
    if not (folder / RESULTS).exists():
        raise UnreadableError(f"no {RESULTS}: the job has only begun, or ended before it could write any")
    content = read_json(folder / RESULTS)
    if not (isinstance(content, dict) and isinstance(content.get("status"), str) and "table" in content):
        raise UnreadableError(f"{RESULTS} is not hno's: it has no status and table")
    return content


def _run(folder: Path, name: str, content: Mapping[str, Any]) -> Run:
    notes: list[str] = []
    if content.get("schema") not in SCHEMAS:
        notes.append(f"{RESULTS} has schema {content.get('schema')!r}; known are {SCHEMAS}")
    game, operator, activation = (_name(content.get(key)) for key in ("game", "operator", "activation"))
    return Run(
        name, content["status"], _text(content.get("reason")), game, operator, activation, whole(content.get("seed")),
        content,
        tuple(_each(content.get("table"), type_result, "row of the table", notes)),
        _settings(folder, content, notes),
        _curves(folder / METRICS, notes),
        tuple(_episodes(folder, content, notes)),
        command_of(folder),
        tuple(notes),
    )  # fmt: skip


def _name(value: Any) -> str:
    return value if isinstance(value, str) and value else NOT_AVAILABLE


def _text(value: Any) -> str | None:
    return None if value is None else str(value)


def _each(entries: Any, parse: Callable[[Any], T], what: str, notes: list[str]) -> list[T]:
    if not isinstance(entries, list):
        notes.append(f"expected a list of each {what}; got {type(entries).__name__}")
        return []
    found = []
    for entry in entries:
        try:
            found.append(parse(entry))
        except UnreadableError as error:
            notes.append(f"a {what} is left out: {error}")
    return found


def _curves(path: Path, notes: list[str]) -> Curves:
    if not path.exists():
        return {}
    try:
        return curves(path)
    except UnreadableError as error:
        notes.append(f"no learning curves: {error}")
        return {}


def _episodes(folder: Path, content: Mapping[str, Any], notes: list[str]) -> list[Episode]:
    name = content.get("episodes")
    if not isinstance(name, str):
        return []
    path = folder / Path(name).name  # a name inside the folder, whatever the file says
    try:
        entries = read_json(path)
    except UnreadableError as error:
        notes.append(f"no episodes: {error}")
        return []
    return _each(entries.get("episodes") if isinstance(entries, dict) else None, episode, "episode", notes)


def _settings(folder: Path, content: Mapping[str, Any], notes: list[str]) -> dict[str, str]:
    config = content.get("config")
    if not isinstance(config, dict):
        try:
            config = read_yaml(folder / ".hydra" / "config.yaml")
        except UnreadableError as error:
            notes.append(f"no settings: {error}")
    found = flatten(config) if isinstance(config, dict) else {}
    return {**found, "checkpoint": str(content.get("checkpoint"))} if "checkpoint" in found else found


def label_statistics(run: Run) -> list[Mapping[str, Any]]:
    """What is known about a run's training labels, one entry per type."""
    return records(run.content.get("label_statistics"))
