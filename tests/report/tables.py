"""Tables and episodes as runs leave them, made by hand."""

from __future__ import annotations

import math
from typing import Any

from hno.evaluation.closed_loop import TypeRow
from hno.evaluation.metrics import clopper_pearson
from hno.evaluation.outcome import Outcome


def type_row(
    theta: tuple[float, ...], collisions: int, safe: int, excess: float = 1.0, cost: float = 10.0, seen: bool = True
) -> dict[str, Any]:
    """One row of results.json's table."""
    some = safe > 0
    found = Outcome(
        safe + 1, 0, 1, 0, 0, safe, collisions, collisions / safe if some else None, clopper_pearson(collisions, safe),
        2.0 if some else None, None, excess if some else None, None, None, cost if some else None, None,
    )  # fmt: skip
    return TypeRow(theta, seen, False, False, found, None, None).content()


def episode(theta: tuple[float, float], clearance: float, dimensions: int = 2, frames: int = 4) -> dict[str, Any]:
    """Two players who pass each other, as an entry of episodes.json."""
    t = [0.5 * k for k in range(frames)]
    right = [[20 * s, math.sin(s), 0.1 * s][:dimensions] for s in t]
    left = [[70 - 20 * s, 2 - math.sin(s), 0.0][:dimensions] for s in t]
    positions = [list(pair) for pair in zip(right, left, strict=True)]
    return {"theta": list(theta), "kind": "worst", "clearance": clearance, "t": t, "positions": positions,
            "radius": [1.5] * frames}  # fmt: skip
