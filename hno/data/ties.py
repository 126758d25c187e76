"""Start states at which the two cheapest equilibria cost nearly the same."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from hno.data.branches import rotations
from hno.games import Game
from hno.pontryagin.solve import Solver, solve
from hno.types import Extremal, Status, part

TIE = 0.01
"""Relative difference of joint costs up to which two equilibria are tied."""
APART = 1.0
"""Rotation, rad, by which best equilibria of two starts differ if they go different ways around each other."""
HALVINGS = 10
"""Of the line between two starts, at most."""
BATCH = 32
"""Pairs of starts that are tried together."""
MOST = 40
"""Pairs that are tried for one tie, at most."""


class TooFewTiesError(ValueError):
    """A game in which two ways around each other hardly ever cost the same."""


def tie_states(
    game: Game, theta: tuple[float, ...], count: int, draw: Callable[[int], Tensor], settings: Solver = Solver()
) -> Tensor:
    """Ties on lines between pairs of random starts whose best equilibria go different ways around each other.

    Each line is halved towards the change until the two best equilibria at its middle are tied.

    Args:
        game: the game.
        theta: player types.
        count: number of ties.
        draw: so many random start states, float64, (size, P, n); more of them begin with the fewer.
        settings: of the solver.

    Returns:
        Start states, float64, (count, P, n).

    Raises:
        TooFewTiesError: `MOST` pairs for each do not have so many; one player has none.
    """
    found, pairs = list[Tensor](), 0
    while game.players > 1 and len(found) < count and pairs < MOST * count:
        ends = draw(2 * (pairs + BATCH))[2 * pairs :].unflatten(0, (BATCH, 2))
        found += _between(game, theta, ends, settings)
        pairs += BATCH
    if len(found) < count:
        raise TooFewTiesError(
            f"{type(game).__name__} has {len(found)} ties of two equilibria in {pairs} pairs of starts at types "
            f"{theta}; {count} were asked for."
        )
    return torch.stack(found[:count])


def tied(found: Extremal) -> Tensor:
    """For every start, whether its two best converged equilibria are tied, (starts,); `found` has all equilibria."""
    cost = _costs(found).sort(-1).values
    return cost[:, 1] - cost[:, 0] <= TIE * cost[:, 0].abs() if cost.shape[1] > 1 else torch.zeros(len(cost)).bool()


def _costs(found: Extremal) -> Tensor:
    """Joint costs of each start's equilibria, inf where there are fewer or one did not converge, (starts, most)."""
    counts = torch.bincount(found.start, minlength=found.starts)
    place = torch.arange(len(found.start)) - (counts.cumsum(0) - counts)[found.start]
    table = found.t.new_full((found.starts, int(counts.max())), torch.inf)
    table[found.start, place] = found.cost.where(found.status == Status.CONVERGED, torch.inf)
    return table


def _between(game: Game, theta: tuple[float, ...], ends: Tensor, settings: Solver) -> list[Tensor]:
    """Ties on the lines between pairs of starts (B, 2, P, n), in the order of the pairs."""
    first, last = ends.unbind(1)
    way_first, way_last = (_way(game, _solved(game, theta, end, settings)) for end in (first, last))
    differ = (way_first - way_last).norm(dim=(1, 2)) > APART
    rows, ties = differ.nonzero().squeeze(-1), dict[int, Tensor]()
    for _ in range(HALVINGS):
        if len(rows) == 0:
            break
        middle = (first[rows] + last[rows]) / 2
        found = _solved(game, theta, middle, settings)
        tie = tied(found)
        ties |= {int(row): state for row, state in zip(rows[tie], middle[tie], strict=True)}
        way = _way(game, found)
        near_first = (way - way_first[rows]).norm(dim=(1, 2)) < (way - way_last[rows]).norm(dim=(1, 2))
        first[rows] = torch.where(near_first[:, None, None], middle, first[rows])
        last[rows] = torch.where(near_first[:, None, None], last[rows], middle)
        rows = rows[~tie & way.isfinite().all(-1).all(-1)]
    return [ties[row] for row in sorted(ties)]


def _solved(game: Game, theta: tuple[float, ...], x0: Tensor, settings: Solver) -> Extremal:
    types = torch.tensor(theta, dtype=torch.float64).expand(len(x0), -1)
    return solve(game, x0, types, settings, all_equilibria=True)


def _way(game: Game, found: Extremal) -> Tensor:
    """Rotations of every start's cheapest equilibrium, NaN where none converged, (starts, pairs, 3)."""
    best = _costs(found).argmin(-1) + torch.searchsorted(found.start, torch.arange(found.starts))
    chosen = part(found, best)
    turned = rotations(game, chosen.x)
    return turned.where((chosen.status == Status.CONVERGED)[:, None, None], torch.nan)
