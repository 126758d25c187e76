"""What labels must be to be trained on, played from or written down."""

from __future__ import annotations

import torch

from hno.games import Game
from hno.types import Extremal, Status

WHOLE = ("status", "start")
"""Columns of whole numbers."""
TRUSTED = ("x", "costate", "u", "value", "clearance", "reintegration")
"""Columns that are finite where a label converged."""


def flaw(labels: Extremal, game: Game | None = None) -> str | None:
    """The first reason for which labels are none, with its row; None for sound ones.

    Rows that did not converge may hold anything but types that are not finite. Gaps, residuals and alternatives may be
    unknown, which is NaN, and so may a potential.

    Args:
        labels: of one game.
        game: whose sizes and horizon they must have.
    """
    return _wrong_shape(labels, game) or _wrong_grid(labels, game) or _wrong_row(labels)


def _wrong_shape(labels: Extremal, game: Game | None) -> str | None:
    sizes = labels.status.shape, labels.t.shape, labels.x.shape, labels.u.shape, labels.alternatives.shape
    if [len(size) for size in sizes] != [1, 1, 4, 4, 2]:
        return f"status, t, x, u and alternatives have shapes {', '.join(str(tuple(size)) for size in sizes)}"
    (rows,), (nodes,), (*_, players, states), (*_, controls), (*_, tried) = sizes
    if game is not None and (players, states, controls) != (game.players, game.state_dim, game.control_dim):
        return (
            f"players, states and controls are {players}, {states}, {controls}, those of {type(game).__name__} "
            f"{game.players}, {game.state_dim}, {game.control_dim}"
        )
    joint = rows, nodes, players
    shapes = {
        "t": (nodes,), "x": (*joint, states), "costate": (*joint, players, states), "u": (*joint, controls),
        "value": joint, "theta": (rows, players), "potential": (rows, nodes), "local_gap": (rows, players),
        "global_gap": (rows, players), "alternatives": (rows, tried),
    }  # fmt: skip
    for name, column in labels._asdict().items():
        if tuple(column.shape) != shapes.get(name, (rows,)):
            return f"{name} has shape {tuple(column.shape)}, expected {shapes.get(name, (rows,))}"
        if column.dtype != torch.int64 if name in WHOLE else not column.is_floating_point():
            return f"{name} holds {column.dtype}"
    return None


def _wrong_grid(labels: Extremal, game: Game | None) -> str | None:
    t, steps = labels.t, labels.start.diff(prepend=labels.start.new_full((1,), -1))
    if len(t) < 2 or not bool(t.isfinite().all() & (t.diff() > 0).all()) or abs(float(t[0])) > 1e-6:
        return f"t must increase from 0; got {t.tolist()[:4]} and so on"
    if game is not None and abs(float(t[-1]) - game.horizon) > 1e-6 * game.horizon:
        return f"t ends at {float(t[-1]):g} s, the horizon is {game.horizon:g} s"
    if not bool(((steps == 0) | (steps == 1)).all()):
        return "start must count the start states from 0, without gaps"
    return None


def _wrong_row(labels: Extremal) -> str | None:
    known = (labels.status >= min(Status)) & (labels.status <= max(Status))
    converged, rows = labels.status == Status.CONVERGED, len(labels.status)
    shared = labels.potential
    wrong = {
        "status is none of Status": ~known,
        "theta is not finite": ~labels.theta.isfinite().all(-1),
        "potential is finite at some times only": ~(shared.isfinite().all(-1) | shared.isnan().all(-1)) & converged,
    }
    for name in TRUSTED:
        column = getattr(labels, name).reshape(rows, -1) if rows else labels.residual.reshape(0, 1)
        wrong[f"{name} is not finite, though the label converged"] = converged & ~column.isfinite().all(-1)
    found = [f"{reason} in row {int(bad.nonzero()[0])}" for reason, bad in wrong.items() if bool(bad.any())]
    return found[0] if found else None
