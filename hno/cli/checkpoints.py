"""Checkpoints as people name them: a file, or the folder of a run."""

from __future__ import annotations

from pathlib import Path

from hno.training.checkpoint import CheckpointError
from hno.training.fit import LAST
from hno.training.validation import BEST


def trained(path: str) -> Path:
    """The checkpoint to evaluate: the best of a run's folder, or its last one where there is no best.

    Raises:
        CheckpointError: there is none.
    """
    return _found(path, (BEST, LAST))


def resumed(path: str) -> Path:
    """The checkpoint to go on from: the last of a run's folder. Raises as `trained`."""
    return _found(path, (LAST,))


def _found(path: str, names: tuple[str, ...]) -> Path:
    place = Path(path)
    files = [place / name for name in names] if place.is_dir() else [place]
    for file in files:
        if file.is_file():
            return file
    runs = sorted(found.parent.name for name in names for found in place.glob(f"*/{name}"))
    if runs:
        raise CheckpointError(
            f"{path} is the folder of a sweep: name one of its runs, such as {place / runs[0]}. "
            f"It holds {', '.join(dict.fromkeys(runs))}."
        )
    raise CheckpointError(
        f"There is no checkpoint at {' or '.join(map(str, files))}. Train one with `hno train`, or name its folder."
    )
