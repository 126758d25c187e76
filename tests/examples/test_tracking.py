from __future__ import annotations

import pytest
import torch
from hno_examples.tracking import Tracking

import hno
from hno.games.testing import check_game
from tests.examples.conftest import Train


def passed(game: Tracking, size: int = 4) -> torch.Tensor:
    """States in which the riders have passed each other, so that only their lines matter, (size, 2, 2)."""
    across = torch.linspace(-1, 1, size, dtype=torch.float64)
    return torch.stack([torch.full((size, 2), game.length, dtype=torch.float64), across[:, None] * torch.ones(2)], -1)


def test_keeps_the_contract():
    check_game(Tracking())


@pytest.mark.parametrize("stiffness", [1.0, 4.0])
def test_equilibrium_of_a_rider_alone_is_that_of_the_riccati_equation(stiffness: float):
    """0 = q - p^2 at q = stiffness, which holds for the terminal weight p = sqrt(q) at all times."""
    game = Tracking(stiffness=stiffness).double()
    x0 = passed(game)
    found = hno.solve(game, x0, torch.ones(4, 2, dtype=torch.float64))
    root = stiffness**0.5
    torch.testing.assert_close(found.value[:, 0], -root * x0[..., 1].square(), atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(found.u[:, 0, :, 0], -root * x0[..., 1], atol=1e-3, rtol=1e-3)


def test_trains(train: Train):
    trained = train(Tracking(), [(1, 1), (5, 5)])
    assert trained.after < 0.5 * trained.before
