"""Labelled trajectories as rows of a table."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from hno.games import Game
from hno.types import Extremal, Labels, Points, Sample, Status, Types


class NoLabelsError(RuntimeError):
    """Not a single label could be solved."""


def rows_of(game: Game, extremals: Sequence[Extremal]) -> Sample:
    """Every node of every converged trajectory, one per row, float32.

    Raises:
        NoLabelsError: none converged.
    """
    good = [e.status == Status.CONVERGED for e in extremals]
    if not any(bool(mask.any()) for mask in good):
        raise NoLabelsError(
            f"None of {sum(len(mask) for mask in good)} boundary value problems of {type(game).__name__} converged, "
            "so there is nothing to learn from. Check the game with hno.games.testing.check_game."
        )
    columns = zip(*(_columns(game, e, mask) for e, mask in zip(extremals, good, strict=True)), strict=True)
    tau, x, theta, value, costate = (torch.cat(column).float() for column in columns)
    distinct, which = theta.unique(dim=0, return_inverse=True)
    return Sample(Points(tau, x, theta), Labels(value, costate), Types(distinct, which))


def _columns(game: Game, found: Extremal, good: Tensor) -> tuple[Tensor, ...]:
    count, nodes = int(good.sum()), len(found.t)
    tau = (game.horizon - found.t).expand(count, -1)
    theta = found.theta[good].unsqueeze(1).expand(-1, nodes, -1)
    return tuple(part.flatten(0, 1) for part in (tau, found.x[good], theta, found.value[good], found.costate[good]))
