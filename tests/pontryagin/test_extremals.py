"""Properties that every extremal of the games of the paper has."""

from __future__ import annotations

import functools

import pytest
import torch
from torch import Tensor

from hno.games import Game, make
from hno.games.base import own_costate
from hno.pontryagin import Solver, solve
from hno.pontryagin.adjoint import pmp_rate
from hno.types import Extremal, Status
from tests.pontryagin.encounters import FIRST, central_difference, starts, types


@functools.cache
def solved(name: str) -> tuple[Game, Extremal]:
    """Two extremals on a uniform fine grid, without further nodes, so that the grid shows all that was solved for."""
    game = make(name)
    game.label_step = 0.025
    found = solve(game, starts(game, 2), types(2, 1, 5), Solver(extra_nodes=0))
    assert found.status.tolist() == [Status.CONVERGED] * 2
    return game.double(), found


def along(theta: Tensor, x: Tensor) -> Tensor:
    return theta.unsqueeze(1).expand(x.shape[:-1])


def control_course(game: Game, found: Extremal, parts: int) -> Tensor:
    """Controls at `parts` points per interval from Hermite interpolation of own costates, (B, N * parts + 1, P, m)."""
    own = own_costate(found.costate)
    rates = torch.cat(pmp_rate(game, found.x, own, along(found.theta, found.x)), -1)
    z, width = torch.cat([found.x, own], -1), found.t.diff()[None, :, None, None, None]
    s = torch.arange(parts, dtype=z.dtype).div(parts)[:, None, None]
    left, right, slope, next_slope = (part.unsqueeze(2) for part in (z[:, :-1], z[:, 1:], rates[:, :-1], rates[:, 1:]))
    inner = (1 + 2 * s) * (1 - s) ** 2 * left + s**2 * (3 - 2 * s) * right
    inner = inner + width * (s * (1 - s) ** 2 * slope - s**2 * (1 - s) * next_slope)
    course = torch.cat([inner.flatten(1, 2), z[:, -1:]], 1)
    return game.best_response(*course.chunk(2, -1))


def replay(game: Game, x0: Tensor, theta: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Runge-Kutta on states and spent cost under a course of controls at whole and half steps.

    Returns:
        States at the end of every step, (..., K, P, n), and values (..., P).
    """
    steps = (u.shape[-3] - 1) // 2
    dt = game.horizon / steps

    def rate(x: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
        return game.dynamics(x, at), game.running_cost(x, at, theta)

    x, spent, path = x0, torch.zeros_like(theta), [x0]
    for k in range(steps):
        begin, middle, end = u[..., 2 * k : 2 * k + 3, :, :].unbind(-3)
        a, cost_a = rate(x, begin)
        b, cost_b = rate(x + dt / 2 * a, middle)
        c, cost_c = rate(x + dt / 2 * b, middle)
        d, cost_d = rate(x + dt * c, end)
        x = x + dt / 6 * (a + 2 * b + 2 * c + d)
        spent = spent + dt / 6 * (cost_a + 2 * cost_b + 2 * cost_c + cost_d)
        path.append(x)
    return torch.stack(path, -3), game.terminal_value(x) - spent


@pytest.mark.parametrize("name", FIRST)
def test_the_controls_drive_the_states(name):
    game, found = solved(name)
    x, value = replay(game, found.x[:, 0], found.theta, control_course(game, found, 4))
    assert ((x[:, ::2] - found.x).abs() / game.state_box.width).max() < 2e-3
    torch.testing.assert_close(value, found.value[:, 0], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("name", FIRST)
def test_own_costates_are_the_gradient_of_the_own_value_at_everybodys_fixed_controls(name):
    game, found = solved(name)
    u = control_course(game, found, 4)
    slope = central_difference(lambda at: replay(game, at, found.theta, u)[1], found.x[:, 0], 1e-4)
    scale = slope.abs().amax((0, 1, 2))
    assert ((found.costate[:, 0] - slope).abs() / scale).max() < 1e-2


@pytest.mark.parametrize("name", FIRST)
def test_no_player_gains_by_changing_its_own_controls_a_little(name):
    game, found = solved(name)
    u = control_course(game, found, 4)
    x0, theta = found.x[:, 0], found.theta
    value = replay(game, x0, theta, u)[1]
    s = torch.linspace(0, torch.pi, u.shape[1], dtype=u.dtype)
    waves = torch.stack([sign * torch.sin(k * s) for sign in (1, -1) for k in (1, 2, 3)])
    bumps = 0.02 * torch.einsum("wt,cd->wctd", waves, torch.diag(game.control_box.width)).flatten(0, 1)
    for player in range(2):
        changed = u.expand(len(bumps), *u.shape).clone()
        changed[..., player, :] += bumps.unsqueeze(1)
        gain = replay(game, x0.expand(len(bumps), *x0.shape), theta, game.control_box.clamp(changed))[1] - value
        assert gain[..., player].max() < 1e-3


@pytest.mark.parametrize("name", FIRST)
def test_the_hamiltonian_of_the_shared_problem_is_conserved(name):
    """Players of these games share one penalty, so <lambda_11, f_1> + <lambda_22, f_2> - efforts - penalty is constant.

    Each player's own Hamiltonian is not: along an open-loop equilibrium it changes with the other's control.
    """
    game = make(name)
    found = solve(game, starts(game, 2), types(2, 1, 5), Solver(extra_nodes=120))
    game = game.double()
    assert found.status.tolist() == [Status.CONVERGED] * 2
    penalty = game.penalty(found.x, along(found.theta, found.x))[..., 0]
    flow = (own_costate(found.costate) * game.dynamics(found.x, found.u)).sum((-2, -1))
    energy = flow - game.effort(found.u).sum(-1) - penalty
    assert (energy.amax(1) - energy.amin(1)).max() < 2e-4 * penalty.max().clamp_min(1000)


@pytest.mark.parametrize("name", FIRST)
def test_both_ends_meet_their_conditions(name):
    game, found = solved(name)
    torch.testing.assert_close(found.x[:, 0], starts(make(name), 2), rtol=0, atol=1e-12)
    torch.testing.assert_close(found.value[:, -1], game.terminal_value(found.x[:, -1]))
    end = found.x[:, -1].clone().requires_grad_()
    slope = torch.autograd.grad(game.terminal_value(end).sum(), end)[0]
    torch.testing.assert_close(own_costate(found.costate[:, -1]), slope, rtol=1e-8, atol=1e-8)
    assert found.costate[:, -1, [0, 1], [1, 0]].abs().max() == 0


@pytest.mark.parametrize("name", FIRST)
def test_controls_maximise_the_hamiltonian_within_their_box(name):
    game, found = solved(name)
    torch.testing.assert_close(found.u, game.optimal_control(found.x, found.costate), rtol=1e-7, atol=1e-7)
    assert game.control_box.widened(1 + 1e-6).contains(found.u.flatten(0, 2)).all()


@pytest.mark.parametrize("name", ["narrow_road", pytest.param("drone", marks=pytest.mark.slow)])
def test_swapping_the_players_swaps_the_solution(name):
    game = make(name)
    x0, theta = starts(game, 2), types(2, 1, 5)
    found, mirrored = solve(game, x0, theta), solve(game, x0.flip(1), theta.flip(1))
    width = game.state_box.width[0]
    torch.testing.assert_close(mirrored.x.flip(2) / width, found.x / width, rtol=0, atol=1e-6)
    torch.testing.assert_close(mirrored.value.flip(2), found.value, rtol=1e-6, atol=1e-6)
    scale = found.costate.abs().amax()
    torch.testing.assert_close(mirrored.costate.flip(2, 3) / scale, found.costate / scale, rtol=0, atol=1e-6)


def test_the_kept_start_has_the_largest_sum_of_values():
    game = make("narrow_road")
    found = solve(game, starts(game, 3), types(3, 1, 5))
    best = found.alternatives.nan_to_num(-torch.inf).amax(-1)
    torch.testing.assert_close(found.value[:, 0].sum(-1), best)
    assert (found.alternatives.isfinite().sum(-1) > 1).any()


def test_clearance_is_at_most_that_of_the_label_nodes():
    game, found = solved("lane_change")
    at_nodes = -game.constraint(found.x, along(found.theta, found.x)).amax((1, 2, 3))
    assert (found.clearance <= at_nodes).all()
    assert (found.clearance > at_nodes - 0.5).all()
