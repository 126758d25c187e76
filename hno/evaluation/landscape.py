"""What the page of a report shows of a controller: its graph, coordinates, and Python's own values on one plane."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hno.control import Feedback
from hno.control.exported import ExportedPolicy
from hno.control.slices import Slice, base_state, chosen_plane, take
from hno.data.labels import Report
from hno.data.states import equilibria_from
from hno.export.page_program import page_program
from hno.games import Game
from hno.types import Status

log = logging.getLogger(__name__)

LANDSCAPE = "landscape.js"
"""File beside a run's results."""
POINTS = 21
"""Points along each side of the grid at which Python's own values are written, unless there is a truth."""
DIGITS = 5
"""Significant digits of written numbers."""


def landscape(
    policy: Feedback,
    truth: int = 0,
    cache: Path | None = None,
    workers: int | None = None,
    report: Report | None = None,
) -> dict[str, Any]:
    """JSON content of a landscape.

    Args:
        policy: whose.
        truth: points along each side of the game's own slice at which equilibria are solved; 0 for none.
        cache: folder of label files; needed for a truth.
        workers: as of `equilibria_from`.
        report: likewise.
    """
    game = policy.game
    plane = chosen_plane(game, None, None, None)
    own = take(policy, plane, None, None, truth or POINTS)
    program, reason = _program(policy)
    return {
        "program": program, "reason": reason, "players": game.players, "states": game.state_dim,
        "horizon": game.horizon, "unit": game.constraint_unit, "potential": policy.operator.potential,
        "coordinates": _coordinates(game), "start": base_state(game).flatten().tolist(), "theta": _box(game.type_box),
        "plane": {"across": _side(own, 0), "up": _side(own, 1), "at": dict(plane.at)},
        "python": _arrays(own),
        "truth": _truth(game, own, cache, workers, report) if truth and cache else None,
    }  # fmt: skip


def _program(policy: Feedback) -> tuple[dict[str, Any] | None, str | None]:
    """The graph; or None and why a page cannot evaluate the controller."""
    if isinstance(policy, ExportedPolicy):
        return None, "an exported controller has no graph"
    try:
        return page_program(policy.operator), None
    except Exception as error:  # a network from outside may fail in any way, and costs the page its sliders alone
        reason = f"{type(error).__name__}: {error}".split("\n")[0][:300]
        log.warning("The page shows the default slice alone, since this controller has no graph: %s", reason)
        return None, reason


def script(content: Mapping[str, Any]) -> str:
    """A file that hands the content to the page that loads it; pages from disk can load scripts, but no JSON."""
    return f"hnoLandscape({json.dumps(content, separators=(',', ':'), allow_nan=False)});\n"


def _coordinates(game: Game) -> list[dict[str, Any]]:
    return [
        {**one._asdict(), "weights": one.weights.flatten().tolist(), "start": float(one.of(base_state(game)))}
        for one in game.coordinates().values()
    ]


def _box(box: Any) -> list[list[float]]:
    return [box.lo.tolist(), box.hi.tolist()]


def _side(own: Slice, k: int) -> dict[str, Any]:
    values = own[k].values
    return {"name": own[k].name, "lo": float(values[0]), "hi": float(values[-1])}


def _arrays(own: Slice) -> dict[str, Any]:
    """Values of a slice as nested lists, null where they are not finite."""
    names = ("value", "potential", "costate", "control", "constraint")
    parts = {name: _plain(part) for name in names if (part := getattr(own, name)) is not None}
    return {"points": len(own.across.values), "tau": own.tau, "theta": list(own.theta), **parts}


def _plain(part: NDArray[np.float64]) -> list[float | None]:
    """Flat, rounded to `DIGITS`."""
    return [float(f"{one:.{DIGITS}g}") if np.isfinite(one) else None for one in part.ravel().tolist()]


def _truth(
    game: Game, own: Slice, cache: Path, workers: int | None, report: Report | None
) -> dict[str, Any]:
    """What equilibria say at the states of a slice, as `_arrays`; null where none was found."""
    x0 = torch.from_numpy(own.x).flatten(0, 1)
    theta = torch.tensor(own.theta, dtype=torch.float64).expand(len(x0), -1)
    found = equilibria_from(game, x0, theta, own.tau, cache, workers=workers, report=report)
    solved = found.status == Status.CONVERGED
    parts: dict[str, Any] = {
        "value": found.value[:, 0],
        "costate": found.costate[:, 0],
        "control": found.u[:, 0],
        "clearance": found.clearance,
    }
    if game.potential:
        parts["potential"] = found.potential[:, 0]
    return {"solved": int(solved.sum()), **{name: _plain(_known(part, solved)) for name, part in parts.items()}}


def _known(part: torch.Tensor, solved: torch.Tensor) -> NDArray[np.float64]:
    shape = (-1, *(1,) * (part.dim() - 1))
    return part.double().where(solved.view(shape), torch.nan).numpy()
