"""Folders of runs and sweeps, as train.py and evaluate.py leave them."""

from __future__ import annotations

import csv
import json
import math
import shlex
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from yaml import YAMLError, safe_load  # type: ignore[import-untyped]  # yaml has no annotations

from hno.data.folders import LOCK, held
from hno.evaluation.page_script import check_script
from hno.evaluation.starts import starts_from
from hno.report.episode import Scene, episode
from hno.report.records import Curves, Run, sentence, type_row
from hno.report.study import FILE as STUDY
from hno.report.study import Study
from hno.report.study import read as read_study

T = TypeVar("T")
RESULTS, METRICS = "results.json", "csv/metrics.csv"
OWN = "episodes", "outcomes", "comparison", "landscape"
"""Entries of results.json that belong to the first of its models alone."""
LOST = {"status": "lost", "reason": "its process ended without a word: it was killed, or its machine failed"}
"""What results become that still say "running" although no process is at work in their folder."""


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
    study: Study | None = None
    """Of a search."""


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
            runs += _runs(folder, name)
        except ValueError as error:
            skipped.append(Skipped(name, str(error)))
        except RecursionError:
            skipped.append(Skipped(name, f"{RESULTS} is nested too deeply to be hno's"))
    if not runs:
        found = "; ".join(f"{entry.name}: {entry.reason}" for entry in skipped[:3]) or f"no {RESULTS} in it or below"
        raise NoRunsError(f"{root} holds no run ({found}). Runs are written by train.py and evaluate.py.")
    study, command = None, _command(root / "multirun.yaml", "-m")
    try:
        study = read_study(root / STUDY)
    except ValueError as error:
        skipped.append(Skipped(STUDY, str(error)))
    if study is not None and command is not None:
        command = f"{command} {shlex.join(study.words)}"
    return Sweep(root.resolve().name, tuple(runs), tuple(skipped), command, study)


def _candidates(root: Path) -> list[Path]:
    """Folders with results, and those where Hydra began a job, 2_drone before 10_drone."""
    marks = [*root.rglob(RESULTS), *root.rglob(".hydra")]
    return sorted({mark.parent for mark in marks}, key=_natural)


def _natural(path: Path) -> list[tuple[float, str]]:
    heads = [(part.split("_")[0], part) for part in path.parts]
    return [(float(head) if head.isdecimal() else math.inf, part) for head, part in heads]


def _runs(folder: Path, name: str) -> list[Run]:
    """The run of a folder, or one for each model of an evaluation.

    Raises:
        ValueError: it has no results, or foreign ones.
    """
    if not (folder / RESULTS).exists():
        raise ValueError(f"no {RESULTS}: the job has only begun, or ended before it could write any")
    content = read_json(folder / RESULTS)
    content = content if at_work(folder, content) else {**content, **LOST}
    models = content.pop("models", None) or [{}]
    if not (isinstance(models, list) and all(isinstance(model, dict) for model in models)):
        raise ValueError(f"{RESULTS} is not hno's: models is no list of objects")
    shared = {key: value for key, value in content.items() if key not in OWN}
    names = [name] if len(models) == 1 else [f"{name} [{k}]" for k in range(len(models))]
    return [
        _run(folder, name, {**(shared if k else content), **model})
        for k, (name, model) in enumerate(zip(names, models, strict=True))
    ]


def at_work(folder: Path, content: Mapping[str, Any]) -> bool:
    """Whether results are what they say: where they say "running", a process holds the lock of their folder."""
    return content.get("status") != "running" or held(folder / LOCK)


def read_json(path: Path) -> dict[str, Any]:
    """What a JSON file holds.

    Raises:
        ValueError: it cannot be read, or is no object.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path.name} cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path.name} is not JSON ({error})") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path.name} is not hno's: expected an object, got a {type(content).__name__}")
    return content


def _run(folder: Path, name: str, content: Mapping[str, Any]) -> Run:
    """A model with what lies beside its results; what cannot be read there is left out and noted."""
    try:
        run = Run.model_validate({**content, "episodes": [], "outcomes": {}, "landscape": None})
    except ValueError as error:
        raise ValueError(f"{RESULTS} is not hno's: {sentence(error)}") from error
    notes, metrics = list[str](), folder / METRICS
    found: dict[str, Any] = {"name": name, "notes": notes, "settings": _flat(run.config or {})}
    if "checkpoint" in found["settings"]:
        found["settings"]["checkpoint"] = str(run.checkpoint)
    found["command"] = _command(folder / ".hydra" / "hydra.yaml")
    found["overrides"] = tuple(shlex.split(found["command"] or "")[2:])
    with _noted(notes, "no landscape"):
        if isinstance(beside := content.get("landscape"), str) and (folder / Path(beside).name).is_file():
            check_script(folder / Path(beside).name)
            found["landscape"] = folder / Path(beside).name
    found["table"] = _each(run.table, type_row, "row of the table", notes)
    with _noted(notes, "no learning curves"):
        found["curves"] = _curves(metrics) if metrics.exists() else {}
    with _noted(notes, "no episodes"):
        played = _beside(folder, content.get("episodes"))
        found["episodes"] = _each(played.get("episodes", []), episode, "episode", notes)
        found["scene"] = Scene.model_validate(played.get("scene", {}))
    with _noted(notes, "no outcomes of single starts"):
        types = _beside(folder, content.get("outcomes")).get("types", [])
        starts = _each(types, starts_from, "list of starts", notes)
        found["outcomes"] = {one.theta: one for one in starts}
    return run.model_copy(update=found)


def _beside(folder: Path, name: Any) -> dict[str, Any]:
    """A file that results name: one inside their folder, whatever they say; empty without a name."""
    return read_json(folder / Path(name).name) if isinstance(name, str) else {}


@contextmanager
def _noted(notes: list[str], what: str) -> Iterator[None]:
    """What cannot be read becomes a note."""
    try:
        yield
    except (ValueError, OSError, csv.Error) as error:
        notes.append(f"{what}: {sentence(error)}")


def _each(entries: Any, read: Callable[[Any], T], what: str, notes: list[str]) -> list[T]:
    """Records of a list; entries that are none are noted."""
    if not isinstance(entries, list):
        notes.append(f"expected a list of each {what}; got {entries!r:.60}")
        return []
    found = list[T]()
    for entry in entries:
        with _noted(notes, f"a {what} is left out"):
            found.append(read(entry))
    return found


def _curves(path: Path) -> Curves:
    """Metrics of a CSV file by step; cells without a finite number and lines that are cut off are left out."""
    found: Curves = {}
    with path.open(encoding="utf-8", newline="") as file:
        for line in csv.DictReader(file, restkey="epoch"):
            for name in line.keys() - {"step", "epoch"}:
                with suppress(ValueError, TypeError):
                    step, value = int(line["step"]), float(line[name])
                    if math.isfinite(value):
                        found.setdefault(name, []).append((step, value))
    return found


def _flat(value: Any, prefix: str = "") -> dict[str, str]:
    """Nested mappings as dotted names with values as JSON text; text stays as it is, empty mappings have no name."""
    if isinstance(value, Mapping):
        nested = (_flat(entry, f"{prefix}.{key}" if prefix else str(key)) for key, entry in value.items())
        return {name: text for entries in nested for name, text in entries.items()}
    return {prefix: value if isinstance(value, str) else json.dumps(value, default=str)}


def _command(path: Path, *flags: str) -> str | None:
    """The command line of a job or a sweep from a file of Hydra's; None where that is missing or damaged."""
    try:
        hydra = safe_load(path.read_text(encoding="utf-8"))["hydra"]
        name = hydra.get("job", {}).get("name", "train")
        how = ["hno", "tune"] if name == "tune" else ["python", f"{name}.py", *flags]
        return shlex.join([*how, *map(str, hydra["overrides"]["task"])])
    except (OSError, ValueError, TypeError, LookupError, AttributeError, YAMLError):
        return None
