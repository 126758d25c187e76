"""An episode of episodes.json as a typed record."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict

Array = NDArray[np.float64]


def _array(value: Any) -> Array:
    return np.asarray(value, dtype=np.float64)


class Episode(BaseModel):
    """One closed-loop episode; F frames, P players, d dimensions."""

    model_config = ConfigDict(frozen=True, arbitrary_types_allowed=True, allow_inf_nan=False)

    theta: tuple[float, ...]
    kind: str = ""
    """ "worst" (smallest clearance of its type) or "typical" (median clearance)."""
    collided: bool = False
    clearance: float | None
    """Smallest value of -constraint."""
    cost: float | None = None
    label_cost: float | None = None
    t: Annotated[Array, BeforeValidator(_array)]
    """Time, s, (F,)."""
    positions: Annotated[Array, BeforeValidator(_array)]
    """m, (F, P, d)."""
    radius: Annotated[Array, BeforeValidator(_array)] | None = None
    """Distance below which it is a collision, m, (F,); None where the constraint is no distance."""
    label_positions: Annotated[Array, BeforeValidator(_array)] | None = None
    """Positions along the equilibrium from the same start, m, (F, P, d)."""


def episode(content: Any) -> Episode:
    """An entry of episodes.json, up to its first frame that is not finite.

    Raises:
        ValueError: arrays are missing or do not fit.
    """
    found = Episode.model_validate(content)
    t, positions = found.t, found.positions
    shapes = [None if array is None else array.shape for array in (t, positions, found.radius, found.label_positions)]
    if t.ndim != 1 or positions.ndim != 3 or positions.shape[2] not in (2, 3):
        raise ValueError(f"times and positions have shapes {shapes[:2]}, expected (F,) and (F, P, 2 or 3)")
    if positions.shape[0] != len(t) or shapes[2] not in (None, t.shape) or shapes[3] not in (None, positions.shape):
        raise ValueError(f"times, positions, radius and equilibrium have shapes {shapes}")
    sound = np.isfinite(t) & np.isfinite(positions).all((1, 2))
    sound &= True if found.radius is None else np.isfinite(found.radius)
    end = len(t) if sound.all() else int(sound.argmin())
    if end == 0:
        raise ValueError("it has no finite frame")
    return found.model_copy(update={name: _first(getattr(found, name), end) for name in _ARRAYS})


_ARRAYS = ("t", "positions", "radius", "label_positions")


def _first(values: Array | None, end: int) -> Array | None:
    return None if values is None or not np.isfinite(values[:end]).all() else values[:end]
