from __future__ import annotations

import torch
from hno_examples.car_and_cyclist import CarAndCyclist

import hno
from hno.control.policy import Feedback
from hno.games.testing import check_game
from tests.examples.conftest import Train


def test_keeps_the_contract():
    check_game(CarAndCyclist())


def test_each_player_has_its_own_limits_and_its_own_effort():
    game = CarAndCyclist()
    x, push = torch.zeros(1, 2, 4), torch.tensor([0.0, 0.0, 1e6, 1e6]).expand(1, 2, 4)
    torch.testing.assert_close(game.best_response(x, push)[0], game.control_box.hi)
    torch.testing.assert_close(game.best_response(x, -push)[0], game.control_box.lo)
    small = game.best_response(x, 1e-6 * push)[0]
    torch.testing.assert_close(small, (1 / (2 * game.effort_weight)).minimum(game.control_box.hi))


def test_trains_and_plays_within_the_limits(train: Train):
    game = CarAndCyclist()
    trained = train(game, [(1, 1), (5, 1)])
    assert trained.after < 0.5 * trained.before
    x0 = game.initial_box.sample(8, torch.Generator().manual_seed(1))
    played = hno.rollout(game, Feedback(trained.operator), x0, torch.ones(8, 2), dt=0.1)
    assert (game.control_box.lo - 1e-6 <= played.u).all()
    assert (played.u <= game.control_box.hi + 1e-6).all()
    ends = played.x[:, -1]
    assert (ends[:, 0, 0] - x0[:, 0, 0] > ends[:, 0, 1] - x0[:, 0, 1]).all()  # the car went along x,
    assert (ends[:, 1, 1] - x0[:, 1, 1] > ends[:, 1, 0] - x0[:, 1, 0]).all()  # the cyclist along y
