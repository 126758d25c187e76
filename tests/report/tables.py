"""Tables and episodes as runs leave them, made by hand."""

from __future__ import annotations

import math
from typing import Any

from tests.report.folders import row


def type_row(
    theta: tuple[float, ...], collisions: int, safe: int, excess: float = 1.0, cost: float = 10.0, seen: bool = True
) -> dict[str, Any]:
    """One row of results.json's table."""
    costs = {"median_excess_cost": excess, "median_label_cost": cost} if safe else {}
    return row(theta, collisions, safe) | {"seen": seen, "starts": safe + 1, "inevitable": 1, **costs}


def episode(theta: tuple[float, float], clearance: float, dimensions: int = 2, frames: int = 4) -> dict[str, Any]:
    """Two players who pass each other, as an entry of episodes.json."""
    t = [0.5 * k for k in range(frames)]
    right = [[20 * s, math.sin(s), 0.1 * s][:dimensions] for s in t]
    left = [[70 - 20 * s, 2 - math.sin(s), 0.0][:dimensions] for s in t]
    positions = [list(pair) for pair in zip(right, left, strict=True)]
    return {"theta": list(theta), "kind": "worst", "clearance": clearance, "t": t, "positions": positions,
            "radius": [1.5] * frames}  # fmt: skip
