"""Folders of runs and sweeps, as train.py and evaluate.py leave them."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from hno.report.episode import Episode, episode
from hno.report.hydra_files import command_of, read_yaml, sweep_of
from hno.report.records import Curves, Run, UnreadableError, curves, each, read_json, read_results, run_of

RESULTS, METRICS, EPISODES = "results.json", "csv/metrics.csv", "episodes.json"


class NoRunsError(ValueError):
    """A folder that holds no run."""


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
    runs, skipped = list[Run](), list[Skipped]()
    for folder in _candidates(root):
        name = root.resolve().name if folder == root else folder.relative_to(root).as_posix()
        try:
            runs += _unchanged(folder, name, _times(folder))
        except UnreadableError as error:
            skipped.append(Skipped(name, str(error)))
    if not runs:
        found = "; ".join(f"{entry.name}: {entry.reason}" for entry in skipped[:3]) or f"no {RESULTS} in it or below"
        raise NoRunsError(f"{root} holds no run ({found}). Runs are written by train.py and evaluate.py.")
    command, planned = sweep_of(root / "multirun.yaml")
    return Sweep(root.resolve().name, tuple(runs), tuple(skipped), command, planned)


def _candidates(root: Path) -> list[Path]:
    """Folders with results, and those where Hydra began a job, 2_drone before 10_drone."""
    marks = [*root.rglob(RESULTS), *root.rglob(".hydra")]
    return sorted({mark.parent for mark in marks}, key=_natural)


def _natural(path: Path) -> list[tuple[float, str]]:
    heads = [(part.split("_")[0], part) for part in path.parts]
    return [(float(head) if head.isdecimal() else math.inf, part) for head, part in heads]


def _times(folder: Path) -> tuple[int, ...]:
    """When each file was last changed, ns; 0 for one that does not exist."""
    paths = (folder / name for name in (RESULTS, METRICS, EPISODES))
    return tuple(path.stat().st_mtime_ns if path.exists() else 0 for path in paths)


@functools.lru_cache(maxsize=1000)
def _unchanged(folder: Path, name: str, times: tuple[int, ...]) -> list[Run]:
    """Runs of a folder that has not changed since are not read again."""
    return read_runs(folder, name)


def read_runs(folder: Path, name: str) -> list[Run]:
    """The run of a folder, or one for each model of an evaluation; what cannot be read beside it is left out and noted.

    Raises:
        UnreadableError: it has no results, or foreign ones.
    """
    if not (folder / RESULTS).exists():
        raise UnreadableError(f"no {RESULTS}: the job has only begun, or ended before it could write any")
    models = read_results(folder / RESULTS)
    names = [name] if len(models) == 1 else [f"{name} [{k}]" for k in range(len(models))]
    return [_run(folder, name, content) for name, content in zip(names, models, strict=True)]


def _run(folder: Path, name: str, content: Mapping[str, Any]) -> Run:
    run = run_of(content, RESULTS)
    settings, said = _settings(folder, run)
    metrics, missed = _curves(folder / METRICS)
    played, unplayed = _episodes(folder, content.get("episodes"))
    found = {"settings": settings, "curves": metrics, "episodes": played, "command": command_of(folder)}
    return run.model_copy(update={"name": name, **found, "notes": [*run.notes, *said, *missed, *unplayed]})


def _settings(folder: Path, run: Run) -> tuple[dict[str, str], list[str]]:
    try:
        config = run.config or read_yaml(folder / ".hydra" / "config.yaml")
    except UnreadableError as error:
        return {}, [f"no settings: {error}"]
    found = flatten(config) if isinstance(config, dict) else {}
    return found | ({"checkpoint": str(run.checkpoint)} if "checkpoint" in found else {}), []


def _curves(path: Path) -> tuple[Curves, list[str]]:
    try:
        return curves(path) if path.exists() else {}, []
    except UnreadableError as error:
        return {}, [f"no learning curves: {error}"]


def _episodes(folder: Path, file: Any) -> tuple[list[Episode], list[str]]:
    if not isinstance(file, str):
        return [], []
    try:
        content = read_json(folder / Path(file).name)  # a name inside the folder, whatever the file says
    except UnreadableError as error:
        return [], [f"no episodes: {error}"]
    return each(content.get("episodes") if isinstance(content, dict) else content, episode, "episode")


def flatten(value: Any, prefix: str = "") -> dict[str, str]:
    """Nested mappings as dotted names with values as JSON text; text stays as it is, empty mappings have no name."""
    if isinstance(value, Mapping):
        return {
            name: text
            for key, entry in value.items()
            for name, text in flatten(entry, f"{prefix}.{key}" if prefix else str(key)).items()
        }
    return {prefix: value if isinstance(value, str) else json.dumps(value, default=str)}
