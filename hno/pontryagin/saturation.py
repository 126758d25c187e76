"""Times at which a control reaches or leaves its bounds: the solution has kinks there, so nodes are put on them."""

from __future__ import annotations

import torch
from torch import Tensor

from hno.games import Game
from hno.pontryagin.certificates import reintegration_error
from hno.pontryagin.collocation import Collocation, Iterate, Newton, hermite, newton, rescue
from hno.types import Status


def nodes_at_kinks(
    game: Game, at: Iterate, residual: Tensor, status: Tensor, settings: Newton, tolerance: float, passes: int = 3
) -> tuple[Iterate, Tensor, Tensor]:
    """Solve again with nodes where controls reach or leave their bounds, which restores the order of the method.

    It concerns trajectories that stalled, and those whose re-integration misses the tolerance. What is not solved on
    its new mesh stays as it was. Kinks move a little with the solution, hence several passes.

    Args:
        game: the game, float64.
        at: trajectories on their first meshes.
        residual: their residuals, (B,).
        status: their `Status`, (B,).
        settings: of Newton's method.
        tolerance: re-integration error that is good enough, in widths of the PDE box.
        passes: how often.

    Returns:
        Trajectories, their residuals (B,) and `Status` (B,). Meshes are filled up with intervals of length 0 at the end.
    """
    equations, first = Collocation(game), at.t
    residual, status = residual.clone(), status.clone()
    for turn in range(passes):
        drift = reintegration_error(game, at)
        wanted = (status == Status.CONVERGED) & (drift > tolerance)
        if turn == 0:
            wanted |= status == Status.STALLED
        rows = wanted.nonzero().squeeze(-1)
        if len(rows) == 0:
            break
        part = at.rows(rows)
        t = torch.cat([first[rows], saturation_times(game, part)], 1).sort(dim=-1).values
        start = Iterate(t, equations.at_times(part, t), part.theta)
        found = newton(equations, start, settings)
        if turn == 0:
            found = rescue(equations, start, found, torch.arange(len(rows), device=rows.device), settings)
        z, size, ended = found
        done = ended == Status.CONVERGED
        length = max(t.shape[1], at.t.shape[1])
        at = at._replace(t=_lengthened(at.t, length), z=_lengthened(at.z, length))
        at.t[rows[done]], at.z[rows[done]] = _lengthened(t, length)[done], _lengthened(z, length)[done]
        residual[rows[done]], status[rows[done]] = size[done], Status.CONVERGED
    return at, residual, status


def _lengthened(part: Tensor, length: int) -> Tensor:
    """The last node repeated until there are `length` nodes, a copy."""
    last = part[:, -1:].expand(-1, length - part.shape[1], *part.shape[2:])
    return torch.cat([part, last], 1)


def saturation_times(game: Game, at: Iterate, bisections: int = 30) -> Tensor:
    """Where a control reaches or leaves its bounds, at most once between a node and an interval's centre.

    Args:
        game: the game, float64.
        at: solved trajectories.
        bisections: of half an interval.

    Returns:
        Times, s, in no order and filled up with the horizon, (B, C); C is the largest count of a row.
    """
    equations = Collocation(game)
    share = torch.tensor([0.0, 0.5, 1.0], dtype=at.z.dtype, device=at.z.device)
    side = _side(game, *equations.split(equations.interpolate(at, share)))
    row, interval, half, player, channel = (side[:, :, 1:] != side[:, :, :-1]).nonzero().unbind(-1)
    rate = equations.rate(at.z, at.theta)
    ends = [part[row, interval + next_] for part in (at.z, rate) for next_ in (0, 1)]
    step = (at.t[row, interval + 1] - at.t[row, interval]).unsqueeze(-1)
    left, width = half / 2, 0.5
    before = side[row, interval, half, player, channel]
    cell = torch.arange(len(row), device=row.device)
    for _ in range(bisections):
        width /= 2
        inside = equations.split(hermite(*ends, step, (left + width).unsqueeze(-1)))
        same = _side(game, *inside)[cell, player, channel] == before
        left = torch.where(same, left + width, left)
    t = at.t[row, interval] + (left + width / 2) * step.squeeze(-1)
    return _padded(row, t, len(at.t), at.t[:, -1:])


def _side(game: Game, x: Tensor, own: Tensor) -> Tensor:
    """-1 at the lower bound, 1 at the upper one, 0 in between, (..., P, m)."""
    scaled = game.control_box.scale(game.best_response(x, own))
    return (scaled >= 1 - 1e-9).to(torch.int8) - (scaled <= -1 + 1e-9).to(torch.int8)


def _padded(row: Tensor, value: Tensor, rows: int, filler: Tensor) -> Tensor:
    """Values of increasing rows as one line per row, (B, C)."""
    count = torch.bincount(row, minlength=rows)
    place = torch.arange(len(row), device=row.device) - (count.cumsum(0) - count)[row]
    table = filler.repeat(1, int(count.max()) if len(row) else 0)
    table[row, place] = value
    return table
