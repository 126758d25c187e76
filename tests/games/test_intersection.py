"""The uncontrolled intersection against its formulas, written out here once more."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from hno.games import Game, make
from hno.games.testing import check_game
from hno.pontryagin import solve
from hno.types import Status

TYPES = torch.tensor([[1.0, 1.0], [1.0, 5.0], [5.0, 5.0], [2.0, 3.0], [1.25, 1.5]], dtype=torch.float64)


@pytest.fixture
def game() -> Game:
    return make("intersection").double()


@pytest.fixture
def states(game: Game) -> Tensor:
    x = game.state_box.sample(5, torch.Generator().manual_seed(0))
    x[:3, :, 0] = torch.tensor([[34.0, 36.0], [36.0, 34.5], [33.0, 40.0]], dtype=torch.float64)
    return x


def test_it_keeps_the_contract(game):
    check_game(game)


def test_the_penalty_is_the_product_over_both_players_of_both_ends(game, states):
    d = states[..., 0]
    ends = torch.sigmoid(5 * (d - 35 + 0.75 * TYPES)) * torch.sigmoid(-5 * (d - 38.75))
    expected = 1e4 * ends.prod(-1)
    torch.testing.assert_close(game.penalty(states, TYPES), expected.unsqueeze(-1).expand(-1, 2))
    u = torch.ones(5, 2, 1, dtype=torch.float64)
    torch.testing.assert_close(game.running_cost(states, u, TYPES), 1 + expected.unsqueeze(-1).expand(-1, 2))


def test_a_collision_is_both_players_inside_their_own_intervals(game, states):
    d, inside = states[..., 0], []
    for row, theta in zip(d, TYPES, strict=True):
        inside.append(all(35 - 0.75 * float(t) <= float(place) <= 38.75 for place, t in zip(row, theta, strict=True)))
    assert game.violates(states, TYPES).tolist() == inside == [False, True, False, False, False]
    assert game.constraint(states, TYPES)[1].flatten().tolist() == pytest.approx([1.75, 1.75])


def test_players_start_before_the_intersection_on_roads_that_cross(game):
    middle = torch.tensor([[36.875, 20.0], [36.875, 20.0]], dtype=torch.float64)
    assert game.positions(middle).abs().max() == 0
    first, second = game.positions(middle + torch.tensor([[-3.0, 0], [2.0, 0]], dtype=torch.float64))
    assert (first.tolist(), second.tolist()) == ([-3, 0], [0, 2])


def test_the_lattice_is_boolean_at_integer_types_and_counts_cells(game):
    theta = torch.cartesian_prod(torch.arange(1.0, 6), torch.arange(1.0, 6))
    for dtype in (torch.float32, torch.float64):
        found = make("intersection").to(dtype).sensors(theta.to(dtype))
        assert found.shape == (25, 2, 400)
        assert set(found.flatten().tolist()) == {0.0, 1.0}
        cells = (theta[:, 0] + 5) * (theta[:, 1] + 5)  # 0.75 m for each unit of the type, and 3.75 m
        torch.testing.assert_close(found.sum(-1), cells.to(dtype).unsqueeze(-1).expand(-1, 2))


def test_entries_are_exact_shares_of_area(game):
    found = game.sensors(torch.tensor([[1.25, 3.5]], dtype=torch.float64))[0, 0].unflatten(-1, (20, 20))
    assert found.sum() == pytest.approx(6.25 * 8.5)
    assert found[8, 6] == pytest.approx(0.25 * 0.5)
    assert (found[8, 10], found[10, 6], found[10, 10]) == pytest.approx((0.25, 0.5, 1.0))
    assert found[7].abs().max() == found[15:].abs().max() == found[:, 15:].abs().max() == 0


def test_types_of_each_player_matter(game):
    theta = torch.tensor([[a, b] for a in (1.0, 1.25, 1.5) for b in (1.0, 1.25, 1.5)], dtype=torch.float64)
    found = game.sensors(theta)
    assert len(found[:, 0].unique(dim=0)) == 9
    torch.testing.assert_close(game.sensors(theta.flip(-1)), found.flip(-2))
    assert not torch.equal(found[1, 0], found[3, 0])


def test_players_give_way():
    game = make("intersection")
    x0 = torch.tensor([[[15.0, 18], [18, 22]], [[19, 24], [16, 19]], [[15, 18], [15, 18.5]]], dtype=torch.float64)
    found = solve(game, x0, torch.tensor([[1.0, 1], [5, 1], [1, 2]], dtype=torch.float64))
    assert found.status.tolist() == [Status.CONVERGED] * 3
    assert found.clearance.min() > 0
    assert found.local_gap.max() < 1e-4
    alone = make("intersection")
    alone.penalty_height = 1e-9
    through = solve(alone, x0, found.theta)
    assert through.clearance.min() < 0
