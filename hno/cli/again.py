"""A sweep that is run again in its folder: what is finished stays, the rest goes on or is repeated."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from hydra.core.override_parser.overrides_parser import OverridesParser
from yaml import YAMLError, safe_load  # type: ignore[import-untyped]  # yaml has no annotations

from hno.cli.arguments import FOLDERS, Arguments, UsageError, as_path, quoted
from hno.cli.resume import changes, newest
from hno.cli.schema import Settings, SettingsError
from hno.report.runs import RESULTS, read_json
from hno.training.checkpoint import CheckpointError, flat
from hno.training.saving import BEST, RESUMED

SKIPPED, RESUMED_JOB, REPEATED, NEW = "skipped", "resumed", "repeated", ""
"""What a sweep that is run again does with a job; a new one has not begun before."""
RECORD = "multirun.yaml"
"""Where Hydra writes down what a sweep was asked for, in its folder."""
HERE = ("data.cache", "data.workers", "trainer.threads", "trainer.print_every", "cache", "workers", "threads")
"""Keys that may be different the next time: they say how work is done on this machine, and change no number."""
OTHERS = ("hydra.mode", "hydra.run.dir", "hydra.sweep.dir", "hydra/launcher")
"""Keys of Hydra's that may be different too, and all of hydra.launcher."""


class Begun(NamedTuple):
    """What a sweep was asked for when it began."""

    command: str
    words: list[str]
    """Its overrides, as Hydra took them."""
    hydra: list[str]
    """Those of Hydra."""


def begun(folder: Path) -> Begun:
    """What the folder of a sweep says of it.

    Raises:
        UsageError: it is no folder of a sweep, or cannot be read.
    """
    try:
        hydra = safe_load((folder / RECORD).read_text(encoding="utf-8"))["hydra"]
        overrides = {part: [str(word) for word in hydra["overrides"][part]] for part in ("task", "hydra")}
        return Begun(str(hydra["job"]["name"]), overrides["task"], overrides["hydra"])
    except (OSError, ValueError, TypeError, LookupError, AttributeError, YAMLError) as error:
        reason = getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"
        raise UsageError(
            f"There is no sweep to go on with in {folder}: {RECORD} cannot be read ({reason}). sweep=<folder> takes "
            "the folder of a sweep, such as multirun/<date>/<time>."
        ) from error


def going_on(given: Arguments) -> tuple[Arguments, Path | None]:
    """The command line of a sweep that is run again, and its folder; otherwise as given, and None.

    The folder is enough: what it was asked for is read from it, but for words of Hydra's, which could run code.

    Raises:
        UsageError: no folder of a sweep, or words that contradict `sweep=`.
    """
    keys = [_key(override) for override in given.overrides]
    if "sweep" not in keys:
        return given, None
    place = [override for override, key in zip(given.overrides, keys, strict=True) if key == "sweep"][-1]
    value = OverridesParser.create().parse_override(f"sweep={as_path(place.partition('=')[2])}").value()
    if not value:
        raise UsageError("sweep= needs the folder of a sweep, such as multirun/<date>/<time>.")
    if other := [key for key in keys if key in FOLDERS and key != "hydra.sweep.subdir"]:
        raise UsageError(
            f"A sweep goes on in its own folder: leave {'--to' if '--to' in given.flags else other[0]} out."
        )
    folder, own = Path(str(value)).absolute(), [word for word in given.overrides if _key(word) != "sweep"]
    before = begun(folder)
    if not any(_identifies(word) for word in own):
        own = [*_harmless(before, folder), *own]
    if any(_key(word) == "resume" for word in own):
        raise UsageError("sweep= goes on with every job by itself, from its own checkpoint: leave resume= out.")
    words = [*own, f"hydra.sweep.dir={quoted(str(folder))}"]
    return given._replace(overrides=words, flags={**given.flags, "--multirun": ""}), folder


def _harmless(before: Begun, folder: Path) -> list[str]:
    """The words of a sweep without those of Hydra. Its names of folders follow from what is swept."""
    others = [word for word in before.hydra if _identifies(word) and _key(word) != "hydra.sweep.subdir"]
    others += [word for word in before.words if "hydra" in _key(word)]
    if others:
        raise UsageError(
            f"The sweep in {folder} began with {others[0]}. Words of Hydra are not taken from a file, since they can "
            "run code: give its whole command line again, with sweep=<folder>."
        )
    return before.words


def check_same(folder: Path, command: str, words: Iterable[str]) -> None:
    """Refuse to go on in the folder of another sweep.

    Args:
        folder: of the sweep.
        command: that is to run in it.
        words: overrides as Hydra takes them.

    Raises:
        UsageError: with the words that differ.
    """
    before = begun(folder)
    if before.command != command:
        raise UsageError(f"{folder} is a sweep of hno {before.command}, not of hno {command}.")
    if pairs := differing(asked([*before.words, *before.hydra]), asked(words)):
        raise UsageError(
            f"{folder} is another sweep:\n{pairs}\nGive the same words again, or none but sweep=<folder>; or begin a "
            "sweep of its own, without sweep=."
        )


def differing(was: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Words of two sweeps that differ, one a line."""
    keys = sorted(key for key in was.keys() | now.keys() if was.get(key) != now.get(key))
    return "\n".join(f"  {key}: {was.get(key, 'not given')}, now {now.get(key, 'not given')}" for key in keys)


def asked(words: Iterable[str]) -> dict[str, str]:
    """What decides which jobs a sweep has and what they do, by key."""
    return {_key(word): word.partition("=")[2] for word in words if _identifies(word)}


def _key(word: str) -> str:
    return word.partition("=")[0].lstrip("+")


def _identifies(word: str) -> bool:
    key = _key(word)
    return key not in (*HERE, *OTHERS, "launcher", "sweep") and not key.startswith(("hydra.launcher.", "launcher."))


def planned(folder: Path, settings: Settings, reads: Sequence[Path] = ()) -> str:
    """What is to be done with a job whose folder this process has for itself.

    Args:
        folder: of the job.
        settings: of the job as they are now.
        reads: files that must be older than results that stay.

    Raises:
        SettingsError: the job there has other settings; with each that differs, and both values.
    """
    found = results(folder)
    if not found:
        return REPEATED if (folder / RESULTS).exists() else NEW
    if found["status"] == "failed":
        return REPEATED
    if changed := {key: pair for key, pair in changes(settings, found).items() if key not in HERE}:
        pairs = "\n".join(f"  {key}: {was!r}, now {now!r}" for key, (was, now) in changed.items())
        raise SettingsError(
            f"The job in {folder} is {found['status']} with other settings, which a file of the configuration has "
            f"changed since:\n{pairs}\nBring it back as it was, or begin a sweep of its own, without sweep=."
        )
    if found["status"] in ("finished", "pruned"):
        since = (folder / RESULTS).stat().st_mtime
        return REPEATED if any(path.stat().st_mtime > since for path in reads) else SKIPPED
    return RESUMED_JOB if "resume" in type(settings).model_fields and _can_go_on(folder) else REPEATED


def results(folder: Path) -> Mapping[str, Any]:
    """What a job left; nothing where it has no results, or none that can be read."""
    with suppress(ValueError, LookupError, TypeError, AttributeError):
        found = read_json(folder / RESULTS)
        if isinstance(found["status"], str) and (found["status"] == "failed" or flat(found["config"])):
            return found
    return {}


def _can_go_on(folder: Path) -> bool:
    try:
        return newest(folder) is not None
    except CheckpointError:  # all are damaged
        return False


def clear(folder: Path) -> None:
    """Remove the checkpoints of a job that is repeated."""
    for name in (BEST, *RESUMED):
        (folder / name).unlink(missing_ok=True)


def command(task: str, folder: Path, place: Sequence[str] = ()) -> str:
    """The command that goes on with a sweep, with words that have to be given again."""
    return shlex.join(["hno", task, f"sweep={folder}", *place])
