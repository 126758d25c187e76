"""What the package promises about its game and its loss term."""

from __future__ import annotations

import torch
from hno_crossroads.game import Crossroads

import hno
from hno.types import Status


def test_the_game_keeps_the_contract() -> None:
    hno.check_game(Crossroads())


def test_cars_that_come_towards_each_other_pass() -> None:
    """Whatever their types, lanes are further apart than two cars keep; who crosses can collide."""
    game, nearest = Crossroads(), torch.full((1, 4, 2), 0.0)
    found = game.constraint(nearest, torch.full((1, 4), 5.0))  # the next ones on the left, opposite, and on the right
    assert (found[..., 1] < 0).all()
    assert (found[..., [0, 2]] > 0).all()


def test_a_quarter_turn_changes_nothing() -> None:
    game = Crossroads().double()
    x = game.state_box.sample(5, torch.Generator().manual_seed(0))
    theta = game.type_box.sample(5, torch.Generator().manual_seed(1))
    turned = game.constraint(x.roll(1, 1), theta.roll(1, 1))
    torch.testing.assert_close(turned, game.constraint(x, theta).roll(1, 1))
    torch.testing.assert_close(game.penalty(x.roll(1, 1), theta.roll(1, 1)), game.penalty(x, theta).roll(1, 1))


def test_equilibria_are_found_and_keep_clear() -> None:
    game = Crossroads()
    starts = game.initial_box.sample(1, torch.Generator().manual_seed(0))
    found = hno.solve(game, starts, torch.ones(1, 4))
    assert found.status.tolist() == [Status.CONVERGED]
    assert (found.clearance > 0).all()
