"""Times at which a control reaches or leaves its bounds: the solution has kinks there, so nodes are put on them."""

from __future__ import annotations

import torch
from torch import Tensor

from hno.games import Game
from hno.pontryagin.certificates import reintegration_error
from hno.pontryagin.collocation import Collocation, Ends, Iterate, hermite
from hno.pontryagin.newton import Newton, newton, rescue
from hno.types import Status

PARTS = (1, 8, 2, 4, 8)
"""Into how many parts each pass splits the intervals with kinks."""


def nodes_at_kinks(
    game: Game, at: Iterate, residual: Tensor, status: Tensor, settings: Newton, tolerance: float
) -> tuple[Iterate, Tensor, Tensor]:
    """Solve again with nodes where controls reach or leave their bounds, which restores the order of the method.

    It concerns trajectories that stalled, and those whose re-integration error is not far below the tolerance. What is
    not solved on its new mesh stays as it was. Kinks move with the solution: where one pass is not enough, the next
    ones also split the intervals around them, more and less finely, because Newton may stall on one mesh and not on
    another.

    Args:
        game: the game, float64.
        at: trajectories on their first meshes.
        residual: their residuals, (B,).
        status: their `Status`, (B,).
        settings: of Newton's method.
        tolerance: largest re-integration error of a label, in widths of the PDE box.

    Returns:
        Trajectories, their residuals (B,) and `Status` (B,). Meshes are filled up with intervals of length 0.
    """
    equations, first = Collocation(game), at.t
    residual, status = residual.clone(), status.clone()
    for turn, parts in enumerate(PARTS):
        drift = reintegration_error(game, at)
        wanted = (status == Status.CONVERGED) & (drift > (tolerance / 2 if turn else tolerance / 100))
        if turn == 0:
            wanted |= status == Status.STALLED
        rows = wanted.nonzero().squeeze(-1)
        if len(rows) == 0:
            break
        part = at.rows(rows)
        kinks = saturation_times(game, part)
        t = torch.cat([first[rows], kinks, *_around(first[rows], kinks, parts)], 1).sort(dim=-1).values
        start = Iterate(t, equations.at_times(part, t), part.theta)
        found = newton(equations, start, settings)
        found = rescue(equations, start, found, torch.arange(len(rows), device=rows.device), settings)
        z, size, ended = found
        done = ended == Status.CONVERGED
        length = max(t.shape[1], at.t.shape[1])
        at = at._replace(t=lengthened(at.t, length), z=lengthened(at.z, length))
        at.t[rows[done]], at.z[rows[done]] = lengthened(t, length)[done], lengthened(z, length)[done]
        residual[rows[done]], status[rows[done]] = size[done], Status.CONVERGED
    return at, residual, status


def _around(t: Tensor, kinks: Tensor, parts: int) -> list[Tensor]:
    """Nodes that split the intervals with kinks into equal parts."""
    right = torch.searchsorted(t.contiguous(), kinks.contiguous()).clamp_min(1)
    low, high = t.gather(1, right - 1), t.gather(1, right)
    filler = kinks >= t[:, -1:]
    return [torch.lerp(low, high, k / parts).where(~filler, kinks) for k in range(1, parts)]


def lengthened(part: Tensor, length: int) -> Tensor:
    """The last node repeated until there are `length` nodes, a copy."""
    last = part[:, -1:].expand(-1, length - part.shape[1], *part.shape[2:])
    return torch.cat([part, last], 1)


def saturation_times(game: Game, at: Iterate, bisections: int = 30) -> Tensor:
    """Where a control leaves a bound or arrives at one, at most once each between a node and an interval's centre.

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
    jump = side[:, :, 1:] - side[:, :, :-1]
    leaving, crossing = (jump != 0).nonzero(), (jump.abs() == 2).nonzero()  # from bound to bound: two kinks
    row, interval, half, player, channel = torch.cat([leaving, crossing]).unbind(-1)
    arrives = torch.arange(len(row), device=row.device) >= len(leaving)
    rate = equations.rate(at.z, at.theta)
    ends = Ends(at.z[row, interval], at.z[row, interval + 1], rate[row, interval], rate[row, interval + 1])
    step = (at.t[row, interval + 1] - at.t[row, interval]).unsqueeze(-1)
    left, width = half / 2, 0.5
    wanted = side[row, interval, half + arrives, player, channel]
    cell = torch.arange(len(row), device=row.device)
    for _ in range(bisections):
        width /= 2
        inside = equations.split(hermite(ends, step, (left + width).unsqueeze(-1)))
        before = (_side(game, *inside)[cell, player, channel] == wanted) != arrives
        left = torch.where(before, left + width, left)
    t = at.t[row, interval] + (left + width / 2) * step.squeeze(-1)
    order = row.argsort(stable=True)
    return _padded(row[order], t[order], len(at.t), at.t[:, -1:])


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
