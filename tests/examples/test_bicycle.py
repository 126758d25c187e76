from __future__ import annotations

import torch
from hno_examples.bicycle import Bicycle

import hno
from hno.games.testing import check_game
from tests.examples.conftest import Train


def test_keeps_the_contract():
    check_game(Bicycle())


def test_steering_turns_in_proportion_to_speed():
    game = Bicycle().double()
    x = torch.tensor([[0.0, 0.0, 0.1, 10.0], [0.0, 0.0, 0.1, 20.0]], dtype=torch.float64)
    rate = game.dynamics(x, torch.tensor([0.1, 0.0], dtype=torch.float64).expand(2, 2))[:, 2]
    torch.testing.assert_close(rate, x[:, 3] * torch.tensor(0.1).double().tan() / game.wheelbase)


def test_equilibrium_controls_maximise_the_hamiltonian():
    """No angle and acceleration of a grid is better than those of the equilibrium, where the matrix is not constant."""
    game = Bicycle().double()
    x0 = game.initial_box.sample(2, torch.Generator().manual_seed(0))
    found = hno.solve(game, x0, torch.ones(2, 2, dtype=torch.float64))
    assert found.status.tolist() == [0, 0]
    x, costate, u = (part.flatten(0, 1) for part in (found.x, found.costate, found.u))
    theta = torch.ones(len(x), 2, dtype=torch.float64)
    best = game.hamiltonian(x, costate, u, theta)
    lo, hi = game.control_box.lo, game.control_box.hi
    for share in torch.cartesian_prod(*[torch.linspace(0, 1, 5, dtype=torch.float64)] * 2):
        for player in range(2):
            other = u.clone()
            other[:, player] = lo + share * (hi - lo)
            assert (game.hamiltonian(x, costate, other, theta)[:, player] <= best[:, player] + 1e-6).all()


def test_trains(train: Train):
    trained = train(Bicycle(), [(1, 1)])
    assert trained.after < 0.5 * trained.before
