"""Pontryagin's field is what finite differences of the Hamiltonian at fixed control say it is."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from hno.games.base import own_costate
from hno.pontryagin.adjoint import (
    cost_gradient,
    dynamics_jacobian,
    pmp_rate,
    pmp_rate_and_jacobian,
    terminal_costate,
)
from tests.lq import random_game
from tests.pontryagin.encounters import NAMES, central_difference, encounters


@pytest.fixture(params=NAMES)
def setting(request):
    return encounters(request.param)


def random_costate(x: Tensor, scale: float) -> Tensor:
    noise = torch.randn(*x.shape[:-1], *x.shape[-2:], generator=torch.Generator().manual_seed(1), dtype=x.dtype)
    return scale * noise


def test_the_penalty_acts_in_these_states(setting):
    game, x, theta = setting
    penalty = game.penalty(x, theta)
    assert penalty.min() > 1
    assert penalty.max() < 9999
    assert penalty.max() > 2 * penalty.min()


@pytest.mark.parametrize("scale", [1.0, 100.0], ids=["free", "saturated"])
def test_own_adjoint_is_minus_the_slope_of_the_hamiltonian_at_fixed_control(setting, scale):
    game, x, theta = setting
    costate = random_costate(x, scale)
    u = game.optimal_control(x, costate)
    slope = own_costate(central_difference(lambda at: game.hamiltonian(at, costate, u, theta), x))
    flow, rate = pmp_rate(game, x, own_costate(costate), theta)
    torch.testing.assert_close(rate, -slope, rtol=1e-6, atol=1e-5 * float(slope.abs().max()))
    torch.testing.assert_close(flow, game.dynamics(x, u))


def test_the_state_moves_as_the_costate_derivative_of_the_hamiltonian(setting):
    game, x, theta = setting
    costate = random_costate(x, 30.0)
    u = game.optimal_control(x, costate)

    base = own_costate(costate)

    def hamiltonian(own: Tensor) -> Tensor:
        changed = costate + torch.diag_embed((own - base).mT, dim1=-3, dim2=-2)
        return game.hamiltonian(x, changed, u, theta)

    slope = own_costate(central_difference(hamiltonian, base, 1e-3))
    torch.testing.assert_close(pmp_rate(game, x, base, theta)[0], slope, rtol=1e-6, atol=1e-6)


def test_cost_gradient_of_every_player_in_every_state(setting):
    game, x, theta = setting
    slope = central_difference(lambda at: game.penalty(at, theta), x)
    assert slope.abs().amax((0, -1)).min() > 1
    torch.testing.assert_close(cost_gradient(game, x, theta), slope, rtol=1e-6, atol=1e-6 * float(slope.abs().max()))


def test_cost_gradient_tells_players_with_different_costs_apart():
    game = random_game(3)
    x = game.state_box.sample(5, torch.Generator().manual_seed(0))
    exact = torch.einsum("pab,rb->rpa", 2 * game.q, x.flatten(-2)).unflatten(-1, x.shape[-2:])
    torch.testing.assert_close(cost_gradient(game, x, x[..., 0]), exact)


def test_terminal_costate_includes_the_other_players_states():
    game = random_game(3)
    x = game.state_box.sample(5, torch.Generator().manual_seed(0))
    exact = torch.einsum("pab,rb->rpa", -2 * game.s, x.flatten(-2)).unflatten(-1, x.shape[-2:])
    torch.testing.assert_close(terminal_costate(game, x), exact)


def test_dynamics_jacobian_at_fixed_control(setting):
    game, x, _ = setting
    u = game.optimal_control(x, random_costate(x, 30.0))
    rows = [central_difference(lambda at, k=k: game.dynamics(at, u)[..., k], x) for k in range(x.shape[-1])]
    slope = torch.stack([own_costate(row) for row in rows], -2)
    torch.testing.assert_close(dynamics_jacobian(game, x, u), slope, rtol=1e-7, atol=1e-7)


def test_jacobian_of_the_field_lets_the_controls_answer(setting):
    game, x, theta = setting
    own = own_costate(random_costate(x, 1.0))
    z = torch.cat([x.flatten(-2), own.flatten(-2)], -1)

    def rate(at: Tensor) -> Tensor:
        parts = pmp_rate(game, *(part.unflatten(-1, x.shape[-2:]) for part in at.chunk(2, -1)), theta)
        return torch.cat([part.flatten(-2) for part in parts], -1)

    step = 1e-5 * torch.eye(z.shape[-1], dtype=z.dtype)
    slope = torch.stack([(rate(z + shift) - rate(z - shift)) / 2e-5 for shift in step], -1)
    found, jacobian = pmp_rate_and_jacobian(game, x, own, theta)
    torch.testing.assert_close(found, rate(z))
    torch.testing.assert_close(jacobian, slope, rtol=1e-5, atol=1e-6 * float(slope.abs().max()))


def test_any_leading_shape(setting):
    game, x, theta = setting
    own = own_costate(random_costate(x, 1.0))
    flat = torch.stack(pmp_rate(game, x, own, theta))
    grid = torch.stack(pmp_rate(game, *(part.unflatten(0, (4, 2, 2)) for part in (x, own, theta))))
    torch.testing.assert_close(grid.flatten(1, 3), flat)
