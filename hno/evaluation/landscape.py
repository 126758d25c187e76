"""What the page of a report shows of a controller: its graph, coordinates, and Python's own values on one plane."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hno.control import Feedback
from hno.control.exported import ExportedPolicy
from hno.control.slices import Side, Slice, chosen_plane, take
from hno.export.page_program import page_program
from hno.games import Game
from hno.types import Extremal, Status

log = logging.getLogger(__name__)

POINTS = 21
"""Points along each side of the grid at which Python's own values are written, unless there is a truth."""
DIGITS = 5
"""Significant digits of written numbers."""
FAILURES = ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError
"""What networks from outside may raise where they are traced: that costs the page its sliders alone."""
Equilibria = Callable[..., Extremal]
"""As `hno.data.states.equilibria_from`, from game, states, types and time to go."""


def landscape(policy: Feedback, truth: int = 0, equilibria: Equilibria | None = None) -> dict[str, Any]:
    """JSON content of a landscape.

    Args:
        policy: whose.
        truth: points along each side of the game's own slice at which equilibria are solved; 0 for none.
        equilibria: solves them.

    Raises:
        ValueError: the game has no slice.
    """
    game = policy.game
    plane = chosen_plane(game, None, None, None)
    own = take(policy, plane, None, None, truth or POINTS)
    program, reason = _program(policy)
    return {
        "program": program, "reason": reason, "players": game.players, "states": game.state_dim,
        "horizon": game.horizon, "unit": game.constraint_unit, "potential": policy.operator.potential,
        "coordinates": _coordinates(game), "start": game.base_state().flatten().tolist(), "theta": _box(game.type_box),
        "plane": {"across": _ends(own.across), "up": _ends(own.up), "at": dict(plane.at)},
        "python": _arrays(own),
        "truth": _truth(game, own, equilibria) if truth and equilibria else None,
    }  # fmt: skip


def _program(policy: Feedback) -> tuple[dict[str, Any] | None, str | None]:
    """The graph; or None and why a page cannot evaluate the controller."""
    if isinstance(policy, ExportedPolicy):
        return None, "an exported controller has no graph"
    try:
        return page_program(policy.operator), None
    except FAILURES as error:
        reason = f"{type(error).__name__}: {error}".split("\n")[0][:300]
        log.warning("The page shows the default slice alone, since this controller has no graph: %s", reason)
        return None, reason


def _coordinates(game: Game) -> list[dict[str, Any]]:
    return [
        {**one._asdict(), "weights": one.weights.flatten().tolist(), "start": float(one.of(game.base_state()))}
        for one in game.coordinates().values()
    ]


def _box(box: Any) -> list[list[float]]:
    return [box.lo.tolist(), box.hi.tolist()]


def _ends(side: Side) -> dict[str, Any]:
    return {"name": side.name, "lo": float(side.values[0]), "hi": float(side.values[-1])}


def _arrays(own: Slice) -> dict[str, Any]:
    """Values of a slice as nested lists, null where they are not finite."""
    names = ("value", "potential", "costate", "control", "constraint")
    parts = {name: _plain(part) for name in names if (part := getattr(own, name)) is not None}
    return {"points": len(own.across.values), "tau": own.tau, "theta": list(own.theta), **parts}


def _plain(part: NDArray[np.float64]) -> list[float | None]:
    """Flat, rounded to `DIGITS`."""
    return [float(f"{one:.{DIGITS}g}") if np.isfinite(one) else None for one in part.ravel().tolist()]


def _truth(game: Game, own: Slice, equilibria: Equilibria) -> dict[str, Any]:
    """What equilibria say at the states of a slice, as `_arrays`; null where none was found."""
    x0 = torch.from_numpy(own.x).flatten(0, 1)
    theta = torch.tensor(own.theta, dtype=torch.float64).expand(len(x0), -1)
    found = equilibria(game, x0, theta, own.tau)
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
