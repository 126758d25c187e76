"""Which way around each other the players go, without words for it: the branches of a potential.

Seen from player i, the position of player j sweeps a rotation while they pass. Equilibria of one start that differ in
how the players get out of each other's way differ in the sign of that rotation: on which side they pass, who is ahead
where they cross, who goes over and who under.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from hno.games import Game
from hno.types import Extremal


def rotations(game: Game, x: Tensor) -> Tensor:
    """Angles that the relative position of every two players sweeps along trajectories, rad.

    Args:
        game: the game; its positions have two or three entries.
        x: states, (B, K, P, n).

    Returns:
        Sums of the rotation vectors from node to node, (B, pairs, 3), pairs in the order (1, 2), (1, 3), (2, 3)
        and so on; in the plane they lie along the third axis.
    """
    place = game.positions(x)
    if place.shape[-1] == 2:
        place = torch.nn.functional.pad(place, (0, 1))
    first, second = torch.triu_indices(game.players, game.players, 1)
    gap = (place[..., second, :] - place[..., first, :]).movedim(-2, 1)
    before, after = gap[:, :, :-1], gap[:, :, 1:]
    normal = torch.linalg.cross(before, after)
    sine, cosine = normal.norm(dim=-1, keepdim=True), (before * after).sum(-1, keepdim=True)
    angle = torch.atan2(sine, cosine)
    return (normal * (angle / sine.clamp_min(1e-12))).sum(-2)


def principal_axes(game: Game, labels: Sequence[Extremal]) -> Tensor:
    """The axis of every two players along which rotations of several equilibria of one start differ most, (pairs, 3).

    Where no start has several equilibria it is the axis along which rotations vary most.
    """
    swept = [rotations(game, found.x) for found in labels]
    apart = [one.diff(dim=0)[found.start.diff() == 0] for one, found in zip(swept, labels, strict=True)]
    spread = torch.cat(apart) if any(len(part) for part in apart) else torch.cat(swept)
    axes = torch.linalg.svd(spread.movedim(1, 0), full_matrices=False).Vh[:, 0]
    largest = axes.abs().argmax(-1, keepdim=True)
    return axes * axes.gather(-1, largest).sign()  # a singular vector has no sign of its own


def branch_of(game: Game, x: Tensor, axes: Tensor) -> Tensor:
    """The branch that trajectories (B, K, P, n) belong to, (B,): bit k says that pair k turns along its axis."""
    side = (rotations(game, x) * axes).sum(-1) > 0
    return (side * 2 ** torch.arange(side.shape[-1], device=x.device)).sum(-1)
