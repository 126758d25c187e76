"""A state cost x' Q x reaches descent, certificates and rollouts as it does labels and residuals.

Labels are compared with the closed form in test_solve.py, residuals in tests/losses/test_hji.py.
"""

from __future__ import annotations

import pytest
import torch

from hno.control.rollout import rollout
from hno.pontryagin.certificates import global_gap, local_gap, replay
from hno.pontryagin.descent import descend
from hno.pontryagin.held_controls import HeldControls
from hno.pontryagin.mesh import label_times
from hno.pontryagin.solve import Solver, solve_on_mesh
from tests.lq import LinearQuadratic, open_loop_nash, quadratic, random_game
from tests.pontryagin.encounters import starts


def team(game: LinearQuadratic) -> LinearQuadratic:
    """One player who steers all states and pays the sum of all costs."""
    drift, inputs = torch.block_diag(*game.a)[None], torch.block_diag(*game.b)[None]
    return LinearQuadratic(drift, inputs, game.r.view(1, -1), game.q.sum(0)[None], game.s.sum(0)[None]).double()


@pytest.mark.parametrize("players", [2, 3])
def test_descent_finds_the_controls_that_minimise_the_sum_of_all_costs(players):
    game = random_game(players, seed=1)
    x0, t = starts(game, 4), torch.linspace(0, 1, 81, dtype=torch.float64)
    exact = -open_loop_nash(team(game), x0.flatten(1).unsqueeze(1), t).value[:, 0, 0]
    problem = HeldControls(game, t, torch.zeros(4, players).double())
    v = torch.zeros(4, 80, players, 1, dtype=torch.float64)
    idle = problem.cost(problem.rollout(x0, v), v)
    _, _, found = descend(problem, x0, v, 20, 1e-9)
    torch.testing.assert_close(found, exact, rtol=2e-3, atol=0)
    assert (idle > 1.02 * exact).all()


@pytest.mark.parametrize("ego", [None, torch.tensor([0, 1, 2, 1])], ids=["joint", "alone"])
def test_curvatures_of_state_costs_are_positive_semidefinite(ego):
    game = random_game(3)
    game.q -= 0.5 * torch.eye(6, dtype=torch.float64)  # no longer convex
    t = torch.linspace(0, 1, 11, dtype=torch.float64)
    problem = HeldControls(game, t, torch.zeros(4, 3).double(), ego=ego)
    v = torch.zeros(4, 10, 3, 1, dtype=torch.float64)
    model = problem.expand(problem.rollout(starts(game, 4), v), v)
    inner = torch.linalg.eigvalsh(model.hessian[:, 1:-1])
    assert inner.amin() > -1e-9
    assert inner.amax() > 0.01


def test_an_equilibrium_with_state_costs_is_one_for_the_certificates_too():
    game = random_game(2, seed=3)
    found = solve_on_mesh(game, starts(game, 4), torch.zeros(4, 2).double())
    assert local_gap(game, found.at).max() < 1e-6
    value = open_loop_nash(game, starts(game, 4), torch.arange(2).double()).value[:, 0]
    torch.testing.assert_close(replay(game, found.at)[1], value, rtol=1e-6, atol=1e-6)


def test_nobody_gains_from_a_manoeuvre_against_an_equilibrium_but_everybody_does_against_its_half():
    game = random_game(2, seed=3)
    x0, t = starts(game, 4), label_times(game, dtype=torch.float64, device=torch.device("cpu"))
    u, theta = open_loop_nash(game, x0, t).u, torch.zeros(4, 2).double()
    assert global_gap(game, x0, t, u, theta, Solver().search).max() < 2e-3
    assert global_gap(game, x0, t, 0 * u, theta, Solver().search).max() < 2e-3  # it is refined before it is compared


def test_a_rollout_pays_the_state_cost():
    game = random_game(3, seed=4)
    x0, idle = starts(game, 4), torch.zeros(4, 3, 1, dtype=torch.float64)
    played = rollout(game, lambda tau, x, theta: idle, x0, torch.zeros(4, 3).double(), substeps=8)
    t = torch.linspace(0, 1, 2001, dtype=torch.float64)
    flow = torch.linalg.matrix_exp(game.joint_drift * t[:, None, None])
    x = torch.einsum("kab,rb->rka", flow, x0.flatten(1)).unflatten(-1, (3, 2))
    exact = torch.trapezoid(quadratic(game.q, x), t, dim=1) + quadratic(game.s, x[:, -1])
    torch.testing.assert_close(played.value, -exact, rtol=1e-4, atol=0)
