"""Geometry that games share."""

from __future__ import annotations

import pytest
import torch

from hno.games.kinematics import separation


@pytest.mark.parametrize("players", [1, 2, 3, 5])
@pytest.mark.parametrize("dimensions", [1, 2, 3])
def test_separation_is_the_distance_to_the_nearest_other_player(players: int, dimensions: int) -> None:
    generator = torch.Generator().manual_seed(players)
    points = torch.randn(7, players, dimensions, generator=generator, dtype=torch.float64)
    apart = torch.cdist(points, points)
    apart.diagonal(dim1=-2, dim2=-1).fill_(torch.inf)
    torch.testing.assert_close(separation(points), apart.amin(-1), rtol=0, atol=1e-9)


def test_separation_has_a_finite_gradient_where_players_touch() -> None:
    points = torch.zeros(3, 2, dtype=torch.float64, requires_grad=True)
    separation(points).sum().backward()
    assert points.grad is not None
    assert bool(points.grad.isfinite().all())
