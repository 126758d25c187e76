from __future__ import annotations

import itertools

import torch
from hno_examples.three_walkers import ThreeWalkers

import hno
from hno.games.testing import check_game
from hno.types import Points
from tests.examples.conftest import Train

ORDERS = [list(order) for order in itertools.permutations(range(3))]


def test_keeps_the_contract():
    check_game(ThreeWalkers())


def test_one_constraint_for_each_other_player():
    """Each is the distance that two of them keep minus the one that they have."""
    game = ThreeWalkers().double()
    x = game.state_box.sample(5, torch.Generator().manual_seed(0))
    theta = game.type_box.sample(5, torch.Generator().manual_seed(1))
    found = game.constraint(x, theta)
    assert found.shape == (5, 3, 2)
    for i in range(3):
        for place, j in enumerate([(i + 1) % 3, (i + 2) % 3]):
            kept = 0.2 + 0.1 * (theta[:, i] + theta[:, j]) + 0.05 * torch.minimum(theta[:, i], theta[:, j])
            torch.testing.assert_close(found[:, i, place], kept - (x[:, i] - x[:, j]).norm(dim=-1))


def test_equilibria_do_not_depend_on_the_order_of_the_players():
    game = ThreeWalkers().double()
    x0 = game.initial_box.sample(2, torch.Generator().manual_seed(0))
    theta = torch.tensor([[0.0, 1.0, 2.0], [0.0, 0.0, 2.0]], dtype=torch.float64)
    first = hno.solve(game, x0, theta)
    order = [2, 0, 1]
    again = hno.solve(game, x0[:, order], theta[:, order])
    assert first.status.tolist() == again.status.tolist() == [0, 0]
    torch.testing.assert_close(again.value, first.value[..., order], atol=1e-4, rtol=1e-4)


def test_trains_to_an_operator_that_does_not_depend_on_their_order(train: Train):
    game = ThreeWalkers()
    trained = train(game, [(0, 0, 0), (0, 1, 2)])
    assert trained.after < 0.5 * trained.before
    x, theta = (box.sample(4, torch.Generator().manual_seed(2)) for box in (game.state_box, game.type_box))
    tau = torch.linspace(0.1, 1, 4)
    field = trained.operator.field(Points(tau, x, theta))
    for order in ORDERS:
        swapped = trained.operator.field(Points(tau, x[:, order], theta[:, order]))
        torch.testing.assert_close(swapped.value, field.value[:, order], atol=1e-3, rtol=1e-4)
        torch.testing.assert_close(swapped.costate, field.costate[:, order][:, :, order], atol=1e-3, rtol=1e-4)
