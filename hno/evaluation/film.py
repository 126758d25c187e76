"""The game's own slice while a controller learns: one small file per validation, and all of them for the page."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hno.control import Feedback
from hno.control.slices import Slice, chosen_plane, take

FILM = "film"
"""Folder beside a run's results."""
POINTS = 17
"""Points along each side of a frame."""
FRAMES = 30
"""Frames that the page plays, at most."""


def shot(policy: Feedback) -> Slice:
    """What a frame shows: the game's own slice. Raises as `Feedback.slice`."""
    return take(policy, chosen_plane(policy.game, None, None, None), None, None, POINTS)


def keep(found: Slice, step: int, folder: Path) -> Path:
    """Write a frame, `film/<step>.npz` with value (U, A, F) of W or of every V_i and violation (U, A), float32."""
    (folder / FILM).mkdir(exist_ok=True)
    path = folder / FILM / f"{step:08d}.npz"
    value = found.value if found.potential is None else found.potential[..., None]
    np.savez_compressed(path, value=value.astype("<f4"), violation=found.violation.astype("<f4"))
    return path


def frames(folder: Path) -> dict[str, Any] | None:
    """The frames of a folder as JSON content, thinned out evenly; None without any.

    Files that are no frames are left out.
    """
    read = [(int(path.stem), found) for path in sorted((folder / FILM).glob("[0-9]*.npz")) if (found := _frame(path))]
    if not read:
        return None
    kept = [read[k] for k in np.unique(np.linspace(0, len(read) - 1, min(FRAMES, len(read))).round().astype(int))]
    return {
        "points": POINTS,
        "violation": _rounded(kept[-1][1]["violation"]),
        "frames": [{"step": step, "values": _rounded(found["value"])} for step, found in kept],
    }


def _frame(path: Path) -> Mapping[str, NDArray[Any]] | None:
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in ("value", "violation")}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return found if found["violation"].shape == (POINTS, POINTS) == found["value"].shape[:2] else None


def _rounded(part: NDArray[Any]) -> list[float | None]:
    return [float(f"{one:.4g}") if np.isfinite(one) else None for one in part.ravel().tolist()]
