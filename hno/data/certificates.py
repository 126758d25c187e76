"""What certificates say about the labels of a set: which starts are safe, and how good the labels are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from hno.types import Extremal, Status, best_of, part

LOCAL_GAP = 1e-4
"""Best-response gap from the equilibrium itself above which a label is doubtful, relative."""
GLOBAL_GAP = 1e-3
"""Best-response gap from several manoeuvres above which an equilibrium is a local one, relative."""
CLEARANCE = 0.02
"""What a safe start's equilibrium keeps by default, in the unit of the game's constraint."""


def safe(found: Extremal, clearance: float = CLEARANCE) -> Tensor:
    """Starts whose equilibrium keeps a clearance, (B,)."""
    return (found.status == Status.CONVERGED) & (found.clearance >= clearance)


def marginal(found: Extremal, clearance: float = CLEARANCE) -> Tensor:
    """Starts whose equilibrium does not collide, but keeps less than a clearance, (B,)."""
    return (found.status == Status.CONVERGED) & (found.clearance > 0) & (found.clearance < clearance)


def inevitable(found: Extremal) -> Tensor:
    """Starts whose equilibrium collides, (B,)."""
    return (found.status == Status.CONVERGED) & (found.clearance <= 0)


def summary(found: Extremal) -> dict[str, Any]:
    """Counts and worst certificates of a label set, JSON content; numbers that do not exist are None.

    Starts are counted by their best equilibrium; certificates are those of all.
    """
    best, solved = best_of(found), found.status == Status.CONVERGED
    local, total = found.local_gap.amax(-1), found.global_gap.amax(-1)
    return {
        "starts": len(best.status),
        "status": {status.name.lower(): int((best.status == status).sum()) for status in Status},
        "safe": int(safe(best).sum()),
        "inevitable": int(inevitable(best).sum()),
        "largest_residual": _largest(found.residual[solved]),
        "largest_reintegration": _largest(found.reintegration[solved]),
        "largest_local_gap": _largest(local[solved]),
        "largest_global_gap": _largest(total[solved]),
        "above_local_gap": int((solved & ~(local <= LOCAL_GAP)).sum()),
        "above_global_gap": int((solved & ~(total <= GLOBAL_GAP)).sum()),
    }


def summaries(labels: Sequence[Extremal]) -> list[dict[str, Any]]:
    """The summary of every type in label sets, with its `theta`."""
    return [
        {"theta": theta.tolist(), **summary(part(found, (found.theta == theta).all(-1)))}
        for found in labels
        for theta in found.theta.unique(dim=0)
    ]


def _largest(values: Tensor) -> float | None:
    return float(values.max()) if len(values) and bool(values.isfinite().all()) else None


def safe_sets(labels: Sequence[Extremal], clearance: float = CLEARANCE) -> list[Extremal]:
    """Labels of starts whose equilibrium keeps a clearance, without sets that have none."""
    selected = [part(found, safe(found, clearance)) for found in labels]
    return [found for found in selected if len(found.status)]
