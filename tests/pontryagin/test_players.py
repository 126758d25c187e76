"""One player, and three: pairwise constraints converge, and interchangeable players can be renamed."""

from __future__ import annotations

import itertools

import pytest
import torch
from torch import Tensor

from hno.control.rollout import rollout
from hno.games import Game
from hno.games.testing import check_game
from hno.pontryagin import solve
from hno.pontryagin.held_controls import distinct_constraints
from hno.types import Status
from tests.crossing import Crossing, Merging, Nearest
from tests.lq import open_loop_nash, random_game
from tests.pontryagin.encounters import starts


def apart(game: Game, count: int) -> tuple[Tensor, Tensor]:
    """Random starts that keep 0.8 m of clearance, and types."""
    generator = torch.Generator().manual_seed(0)
    x0, theta = game.initial_box.sample(80, generator).double(), game.type_box.sample(80, generator).double()
    rows = (game.constraint(x0, theta).amax((1, 2)) < -0.8).nonzero().squeeze(-1)[:count]
    return x0[rows], theta[rows]


@pytest.mark.parametrize("players", [1, 2, 3, 4])
def test_pairs_of_players_are_the_distinct_constraints(players):
    if players == 1:
        assert distinct_constraints(random_game(1)).tolist() == [0]
    else:
        found = distinct_constraints(Merging(players))
        assert len(found) == players * (players - 1) // 2


def test_every_pair_has_a_radius_of_its_own():
    game = Merging().double()
    x, theta = torch.zeros(1, 3, 4).double(), torch.tensor([[0.0, 1.0, 2.0]]).double()
    x[0, :, 0] = torch.tensor([0.0, 1.0, 3.0])
    found = game.constraint(x, theta)[0].sort().values
    pairs = {(0, 1): 0.3 - 1, (0, 2): 0.4 - 3, (1, 2): 0.3 + 0.05 + 0.2 - 2}
    for player in range(3):
        expected = sorted(gap for pair, gap in pairs.items() if player in pair)
        assert found[player].tolist() == pytest.approx(expected, abs=1e-6)


@pytest.mark.slow
def test_three_players_who_keep_distance_pairwise_are_solved():
    game = Crossing()
    check_game(game)
    x0, theta = apart(game, 4)
    found = solve(game, x0, theta)
    assert found.status.tolist() == [Status.CONVERGED] * 4
    assert found.clearance.min() > 1
    assert found.local_gap.max() < 1e-5
    stalled = solve(Nearest(), x0[:1], theta[:1])  # the minimum over the others has kinks
    assert stalled.status.tolist() == [Status.STALLED]


@pytest.mark.parametrize(
    "orders",
    [((1, 0, 2), (1, 2, 0)), pytest.param(tuple(itertools.permutations(range(3))), marks=pytest.mark.slow)],
    ids=["two that all others follow from", "all"],
)
def test_renaming_three_interchangeable_players_renames_the_solution(orders):
    """Where the best equilibrium leads; two that cost the same may change places."""
    game = Merging()
    check_game(game)
    x0, theta = apart(game, 4)
    found = solve(game, x0, theta)
    assert found.status.tolist() == [Status.CONVERGED] * 4
    ranked = found.alternatives.nan_to_num(-torch.inf).sort(descending=True).values
    lead = (ranked[:, 0] - ranked[:, 1]) / ranked[:, 0].abs().clamp_min(1)
    rows = lead > 1e-6
    assert rows.sum() >= 3
    for order in orders:
        renamed = solve(game, x0[:, order], theta[:, order])
        torch.testing.assert_close(renamed.value[rows], found.value[:, :, order][rows], rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(renamed.x[rows], found.x[:, :, order][rows], rtol=0, atol=1e-6)
        costate = found.costate[:, :, order][:, :, :, order][rows]
        torch.testing.assert_close(renamed.costate[rows], costate, rtol=1e-5, atol=1e-5)


def test_one_player_is_a_game_too():
    game = random_game(1)
    check_game(game)
    x0, theta = starts(game, 4), torch.zeros(4, 1).double()
    found, exact = solve(game, x0, theta), open_loop_nash(game, x0, torch.linspace(0, 1, 11).double())
    assert found.status.tolist() == [Status.CONVERGED] * 4
    torch.testing.assert_close(found.value, exact.value, rtol=0, atol=1e-6)
    idle = torch.zeros(4, 1, 1, dtype=torch.float64)
    played = rollout(game, lambda tau, x, theta: idle, x0, theta)
    assert played.distance.tolist() == [torch.inf] * 4
    assert (played.value < found.value[:, 0]).all()
