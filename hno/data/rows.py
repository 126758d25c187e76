"""Labelled trajectories as rows of a table."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from hno.data.branches import branch_of
from hno.games import Game
from hno.games.base import own_costate
from hno.types import Extremal, Labels, Points, PotentialLabels, Sample, Status, Types, part


class NoLabelsError(RuntimeError):
    """Not a single label could be solved."""


def rows_of(game: Game, extremals: Sequence[Extremal]) -> Sample:
    """Every node of every converged trajectory, one per row, with the players' values and costates, float32.

    Raises:
        NoLabelsError: none converged.
    """
    found = converged(game, extremals)
    nodes = [(*_points(each), each.value, each.costate) for each in found]
    tau, x, theta, value, costate = (torch.cat([p.flatten(0, 1) for p in c]).float() for c in zip(*nodes, strict=True))
    return Sample(Points(tau, x, theta), Labels(value, costate), _types(theta))


def potential_rows(game: Game, extremals: Sequence[Extremal], axes: Tensor, *, swapped: bool = False) -> Sample:
    """Every node of every converged trajectory, one per row, with the potential and own costates, float32.

    Args:
        game: a potential game.
        extremals: labels; there may be several of one start.
        axes: of the branches, see `hno.data.branches`.
        swapped: add what the labels say when players of equal role swap: the same, in another order.

    Raises:
        NoLabelsError: none converged.
        ValueError: labels without a potential.
    """
    nodes = []
    for found in converged(game, extremals):
        if not bool(found.potential.isfinite().all()):
            raise ValueError(
                f"Labels of {type(game).__name__} without a potential cannot train one: they are older than it, "
                "or the game's `potential` is False. Solve them anew, or use function=value."
            )
        best = best_equilibria(found)
        for order in orders(game) if swapped else [list(range(game.players))]:
            tau, x, theta = _points(found)
            x, theta, own = x[:, :, order], theta[..., order], own_costate(found.costate)[:, :, order]
            branch = branch_of(game, x, axes).unsqueeze(-1).expand_as(tau)
            rows = tau, x, theta, found.potential.unsqueeze(-1), own.unsqueeze(-3), found.value[..., order]
            nodes.append((*(column.float() for column in rows), best.unsqueeze(-1).expand_as(tau), branch))
    columns = [torch.cat([part.flatten(0, 1) for part in column]) for column in zip(*nodes, strict=True)]
    tau, x, theta, value, own, players, best, branch = columns
    return Sample(
        Points(tau, x, theta), PotentialLabels(value, own, players, best), _types(theta)._replace(branch=branch)
    )


def orders(game: Game) -> Iterator[list[int]]:
    """Orders of the players in which each place keeps its role, the usual one first."""
    everyone = itertools.permutations(range(game.players))
    return (list(order) for order in everyone if [game.roles[player] for player in order] == list(game.roles))


def best_equilibria(found: Extremal) -> Tensor:
    """Whether no other extremal of the same start has a larger potential, (B,)."""
    largest = found.potential.new_full((found.starts,), -torch.inf)
    largest.scatter_reduce_(0, found.start, found.potential[:, 0], "amax")
    return found.potential[:, 0] >= largest[found.start]


def converged(game: Game, extremals: Sequence[Extremal]) -> list[Extremal]:
    """The converged rows.

    Raises:
        NoLabelsError: there is none.
    """
    found = [part(each, each.status == Status.CONVERGED) for each in extremals]
    if not any(len(each.status) for each in found):
        raise NoLabelsError(
            f"None of {sum(len(each.status) for each in extremals)} boundary value problems of {type(game).__name__} "
            "converged, so there is nothing to learn from. Check the game with hno.games.testing.check_game."
        )
    return [each for each in found if len(each.status)]


def _points(found: Extremal) -> tuple[Tensor, Tensor, Tensor]:
    """Times to go (B, K), states (B, K, P, n) and types (B, K, P) of the nodes."""
    count, nodes = len(found.status), len(found.t)
    tau = (found.t[-1] - found.t).expand(count, -1)
    return tau, found.x, found.theta.unsqueeze(1).expand(-1, nodes, -1)


def _types(theta: Tensor) -> Types:
    return Types(*theta.unique(dim=0, return_inverse=True))
