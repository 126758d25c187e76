"""Output folders: one belongs to one run, as long as that is at work and once it has left something."""

from __future__ import annotations

import itertools
import json
import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from hno.cli.arguments import UsageError
from hno.data.folders import LOCK, NO_LOCKS, claimed, holder
from hno.training.saving import BEST, RESUMED

log = logging.getLogger(__name__)

MOMENT = 1.0
"""Time to try for a folder, s: a report that looks whether anybody is at work there holds it for a moment."""


def fresh(folder: Path) -> Path:
    """Make a new folder of this name, or with a number after it where there is one already."""
    for name in itertools.chain([folder.name], (f"{folder.name}_{number}" for number in itertools.count(2))):
        with suppress(FileExistsError):
            folder.with_name(name).mkdir(parents=True)
            break
    return folder.with_name(name)


@contextmanager
def owned(folder: Path, resume: str | None = None, *, jobs: bool = False) -> Iterator[None]:
    """Have a folder for this process alone in a block; others see that somebody is at work there.

    Args:
        folder: of a run or a sweep; it is made where it is missing.
        resume: the checkpoint, or the folder, of the run that goes on.
        jobs: whether it is the folder of a sweep, whose jobs have folders in it.

    Raises:
        UsageError: another process is at work there, or a run has left what would be overwritten.
        OSError: it cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        try:
            ours = stack.enter_context(claimed(folder / LOCK, MOMENT))
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise
            log.warning("%s has no file locks: start no other run there, and see for yourself if one dies.", folder)
            ours = True
        if not ours:
            raise UsageError(f"{folder} is in use by {holder(folder / LOCK)}. Choose another folder with --to.")
        goes_on = resume is not None and folder.resolve() in (Path(resume).resolve(), Path(resume).resolve().parent)
        places = [path for path in sorted(folder.iterdir()) if path.is_dir()] if jobs else [folder]
        left = next((found for place in places if (found := _left(place)) is not None), None)
        if left is not None and not goes_on:
            there = "run the sweep there again: sweep" if jobs else "go on with the run that is there: resume"
            raise UsageError(
                f"{left} would be overwritten. Choose another folder with --to, remove this one, or {there}=<its "
                "folder>."
            )
        yield


def _left(folder: Path) -> Path | None:
    """A file of a run that is worth keeping: a checkpoint, or results of a run that finished."""
    files = [folder / name for name in (BEST, *RESUMED) if (folder / name).exists()]
    results = folder / "results.json"
    with suppress(OSError, ValueError, AttributeError):
        if json.loads(results.read_text()).get("status") == "finished":
            files.append(results)
    return files[0] if files else None
