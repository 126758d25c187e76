"""Content of files that may be partial, foreign or damaged: what is sound is taken, the rest is named."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class UnreadableError(ValueError):
    """A file, or a part of one, that is not what it should be; the message says what is wrong."""


class TypeResult(NamedTuple):
    """What came of the starts of one type; numbers that do not exist are None."""

    theta: tuple[float, ...]
    seen: bool
    """Whether the operator was trained with labels of these types."""
    collisions: int
    starts: int
    """Starts that count: those whose equilibrium is safe."""
    distance: float | None
    """Median over starts of the smallest distance between players, m."""
    excess: float | None
    """Median over starts of the joint cost above the equilibrium's."""
    label_cost: float | None
    """Median over starts of the equilibrium's joint cost."""
    extrapolated: bool = False
    """Whether the types lie outside the box that the game is declared for."""


class Episode(NamedTuple):
    """One closed-loop episode; F frames, P players, d dimensions."""

    theta: tuple[float, ...]
    kind: str
    """ "worst" (smallest clearance of its type) or "typical" (median distance)."""
    collided: bool
    clearance: float | None
    """Smallest distance above the collision radius, m."""
    cost: float | None
    label_cost: float | None
    t: NDArray[np.float64]
    """Time, s, (F,)."""
    radius: NDArray[np.float64]
    """Distance below which it is a collision, m, (F,)."""
    positions: NDArray[np.float64]
    """m, (F, P, d)."""
    equilibrium: NDArray[np.float64] | None
    """Positions along the equilibrium from the same start, m, (F, P, d)."""


Curves = dict[str, tuple[list[int], list[float]]]
"""Metric -> steps and values."""


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


def number(value: Any) -> float | None:
    """A finite number, or None."""
    sound = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if sound else None


def whole(value: Any) -> int | None:
    """A whole number, or None."""
    return value if isinstance(value, int) and not isinstance(value, bool) else None


def records(value: Any) -> list[Mapping[str, Any]]:
    """The mappings of a list; nothing where it is none."""
    return [entry for entry in value if isinstance(entry, dict)] if isinstance(value, list) else []


def type_result(row: Any) -> TypeResult:
    """One row of a collision table.

    Raises:
        UnreadableError: its types or counts are missing or contradict each other.
    """
    if not isinstance(row, dict):
        raise UnreadableError(f"expected a row with theta, safe_starts and collisions; got {row!r:.60}")
    collisions, starts = whole(row.get("collisions")), whole(row.get("safe_starts"))
    if collisions is None or starts is None or not 0 <= collisions <= starts:
        raise UnreadableError(f"{row.get('collisions')!r:.30} collisions of {row.get('safe_starts')!r:.30} safe starts")
    return TypeResult(
        types(row.get("theta")), row.get("seen") is True, collisions, starts,
        number(row.get("median_min_distance")), number(row.get("median_excess_cost")),
        number(row.get("median_label_cost")), row.get("extrapolated") is True,
    )  # fmt: skip


def types(value: Any) -> tuple[float, ...]:
    """Player types.

    Raises:
        UnreadableError: not a list of finite numbers.
    """
    found = [number(entry) for entry in value] if isinstance(value, list) else []
    if not found or None in found:
        raise UnreadableError(f"theta is not a list of numbers: {value!r:.60}")
    return tuple(entry for entry in found if entry is not None)


def episode(value: Any) -> Episode:
    """One entry of episodes.json, up to its first frame that is not finite.

    Raises:
        UnreadableError: arrays are missing or do not fit.
    """
    if not isinstance(value, dict):
        raise UnreadableError(f"an episode is {value!r:.60}")
    t, radius = _array(value, "t", 1), _array(value, "radius", 1)
    positions = _array(value, "positions", 3)
    ghost = _array(value, "label_positions", 3) if value.get("label_positions") is not None else None
    frames = {len(column) for column in (t, radius, positions)}
    if len(frames) != 1 or positions.shape[2] not in (2, 3) or (ghost is not None and ghost.shape != positions.shape):
        raise UnreadableError(f"an episode has shapes {t.shape}, {radius.shape}, {positions.shape}")
    bad = ~(np.isfinite(t) & np.isfinite(radius) & np.isfinite(positions).all((1, 2)))
    end = int(bad.argmax()) if bad.any() else len(t)
    if end == 0:
        raise UnreadableError("an episode has no finite frame")
    if ghost is not None and not np.isfinite(ghost).all():
        ghost = None
    return Episode(
        types(value.get("theta")), str(value.get("kind", "")), value.get("collided") is True,
        number(value.get("clearance")), number(value.get("cost")), number(value.get("label_cost")),
        t[:end], radius[:end], positions[:end], None if ghost is None else ghost[:end],
    )  # fmt: skip


def _array(value: Mapping[str, Any], name: str, dimensions: int) -> NDArray[np.float64]:
    try:
        found = np.asarray(value.get(name), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise UnreadableError(f"{name} of an episode is not an array of numbers ({error})") from error
    if found.ndim != dimensions:
        raise UnreadableError(f"{name} of an episode has {found.ndim} dimensions, expected {dimensions}")
    return found


def curves(path: Path) -> Curves:
    """Metrics of a CSV file, by step; lines that are cut off are left out.

    Raises:
        UnreadableError: no CSV file with a column "step".
    """
    found: Curves = {}
    try:
        with path.open(encoding="utf-8", newline="") as file:
            lines = csv.DictReader(file)
            if "step" not in (lines.fieldnames or ()):
                raise UnreadableError(f"{path.name} has no column 'step'")
            for line in lines:
                _add(found, line)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UnreadableError(f"{path.name} cannot be read ({error})") from error
    return found


def _add(found: Curves, line: Mapping[str | Any, str | Any]) -> None:
    step = _decimal(line["step"])
    for name, text in line.items():
        value = _decimal(text)
        if isinstance(name, str) and name not in ("step", "epoch") and step is not None and value is not None:
            steps, values = found.setdefault(name, ([], []))
            steps.append(int(step))
            values.append(value)


def _decimal(text: Any) -> float | None:
    try:
        return number(float(text))
    except (TypeError, ValueError):
        return None


def flatten(value: Any, prefix: str = "") -> dict[str, str]:
    """Nested mappings as dotted names with values as JSON text; text stays as it is, empty mappings have no name."""
    if isinstance(value, Mapping):
        return {
            name: text
            for key, entry in value.items()
            for name, text in flatten(entry, f"{prefix}.{key}" if prefix else str(key)).items()
        }
    return {prefix: value if isinstance(value, str) else json.dumps(value, default=str)}
