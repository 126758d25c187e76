"""Extremals against exact solutions, and the properties that every equilibrium has."""

from __future__ import annotations

import functools

import pytest
import torch
from torch import Tensor

from hno.games import Box, Game, make
from hno.games.base import own_costate
from hno.pontryagin import Solver, solve
from hno.pontryagin.adjoint import pmp_rate
from hno.pontryagin.solve import join
from hno.types import Extremal, Status
from tests.lq import LinearQuadratic, open_loop_nash, open_loop_riccati, random_game
from tests.pontryagin.encounters import NAMES, central_difference


def starts(game: Game, size: int, seed: int = 0) -> Tensor:
    return game.initial_box.sample(size, torch.Generator().manual_seed(seed)).double()


def types(size: int, *theta: float) -> Tensor:
    return torch.tensor([theta], dtype=torch.float64).expand(size, -1)


# --- linear-quadratic games -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("players", [2, 3])
def test_general_sum_equilibrium_is_the_exact_one(players, seed):
    """States, controls, own and cross costates and values, with different costs for every player."""
    game = random_game(players, seed=seed)
    x0 = starts(game, 4)
    found = solve(game, x0, torch.zeros(4, players))
    exact = open_loop_nash(game, x0, found.t)
    assert found.status.tolist() == [Status.CONVERGED] * 4
    for name in exact._fields:
        torch.testing.assert_close(getattr(found, name), getattr(exact, name), rtol=0, atol=1e-7, msg=name)


@pytest.mark.parametrize("players", [2, 3])
def test_initial_own_costates_follow_the_coupled_riccati_equations(players):
    game = random_game(players, seed=2)
    x0 = starts(game, 4)
    found = solve(game, x0, torch.zeros(4, players))
    exact = torch.einsum("pab,rb->rpa", -2 * open_loop_riccati(game), x0.flatten(-2)).unflatten(-1, (players, 2))
    torch.testing.assert_close(own_costate(found.costate[:, 0]), own_costate(exact), rtol=0, atol=1e-7)


def test_errors_fall_with_the_fourth_power_of_the_mesh_width():
    errors = []
    for label_step in (0.1, 0.05):
        game = random_game(2, label_step=label_step)
        x0 = starts(game, 2)
        found = solve(game, x0, torch.zeros(2, 2), Solver(extra_nodes=0))
        exact = open_loop_nash(game, x0, found.t)
        errors.append([float((getattr(found, name) - getattr(exact, name)).abs().max()) for name in exact._fields])
    for coarse, fine in zip(*errors, strict=True):
        assert 10 < coarse / fine < 22


def test_without_coupling_every_player_solves_its_own_regulator():
    """The scalar Riccati equation of x' = u with cost q x^2 + u^2 has the root sqrt(q) tanh(sqrt(q) tau)."""
    weights = torch.tensor([1.0, 4.0], dtype=torch.float64)
    one = torch.ones(2, 1, 1, dtype=torch.float64)
    running = torch.diag_embed(torch.diag(weights))
    game = LinearQuadratic(0 * one, one, one[..., 0], running, 0 * running).double()
    x0 = starts(game, 3)
    found = solve(game, x0, torch.zeros(3, 2))
    root = weights.sqrt() * torch.tanh(weights.sqrt() * (1 - found.t[:, None]))
    torch.testing.assert_close(found.value, -root * found.x[..., 0].square(), rtol=0, atol=1e-8)
    torch.testing.assert_close(found.u[..., 0], -root * found.x[..., 0], rtol=0, atol=1e-8)


# --- games of the paper ---------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("name", NAMES)
def test_the_controls_drive_the_states(name):
    game, found = solved(name)
    x, value = replay(game, found.x[:, 0], found.theta, control_course(game, found, 4))
    assert ((x[:, ::2] - found.x).abs() / game.state_box.width).max() < 2e-3
    torch.testing.assert_close(value, found.value[:, 0], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("name", NAMES)
def test_own_costates_are_the_gradient_of_the_own_value_at_everybodys_fixed_controls(name):
    game, found = solved(name)
    u = control_course(game, found, 4)
    slope = central_difference(lambda at: replay(game, at, found.theta, u)[1], found.x[:, 0], 1e-4)
    scale = slope.abs().amax((0, 1, 2))
    assert ((found.costate[:, 0] - slope).abs() / scale).max() < 1e-2


@pytest.mark.parametrize("name", NAMES)
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


@pytest.mark.parametrize("name", NAMES)
def test_the_hamiltonian_of_the_shared_problem_is_conserved(name):
    """Players of these games share one penalty, so <lambda_11, f_1> + <lambda_22, f_2> - efforts - penalty is constant.

    Each player's own Hamiltonian is not: along an open-loop equilibrium it changes with the other's control.
    """
    game = make(name)
    found = solve(game, starts(game, 2), types(2, 1, 5), Solver(extra_nodes=120))
    game = game.double()
    assert found.status.tolist() == [Status.CONVERGED] * 2
    penalty = game.penalty(game.constraint(found.x, along(found.theta, found.x)))[..., 0]
    flow = (own_costate(found.costate) * game.dynamics(found.x, found.u)).sum((-2, -1))
    energy = flow - game.effort(found.u).sum(-1) - penalty
    assert (energy.amax(1) - energy.amin(1)).max() < 2e-4 * penalty.max().clamp_min(1000)


@pytest.mark.parametrize("name", NAMES)
def test_both_ends_meet_their_conditions(name):
    game, found = solved(name)
    torch.testing.assert_close(found.x[:, 0], starts(make(name), 2), rtol=0, atol=1e-12)
    torch.testing.assert_close(found.value[:, -1], game.terminal_value(found.x[:, -1]))
    end = found.x[:, -1].clone().requires_grad_()
    slope = torch.autograd.grad(game.terminal_value(end).sum(), end)[0]
    torch.testing.assert_close(own_costate(found.costate[:, -1]), slope, rtol=1e-8, atol=1e-8)
    assert found.costate[:, -1, [0, 1], [1, 0]].abs().max() == 0


@pytest.mark.parametrize("name", NAMES)
def test_controls_maximise_the_hamiltonian_within_their_box(name):
    game, found = solved(name)
    torch.testing.assert_close(found.u, game.optimal_control(found.x, found.costate), rtol=1e-7, atol=1e-7)
    assert game.control_box.widened(1 + 1e-6).contains(found.u.flatten(0, 2)).all()


@pytest.mark.parametrize("name", ["narrow_road", "drone"])
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
    at_nodes = -game.constraint(found.x, along(found.theta, found.x)).amax((1, 2))
    assert (found.clearance <= at_nodes).all()
    assert (found.clearance > at_nodes - 0.5).all()


# --- behaviour ------------------------------------------------------------------------------------------------------


def test_the_same_call_gives_the_same_result_whatever_the_global_generator_holds():
    game = make("lane_change")
    x0, theta = starts(game, 2), types(2, 3, 3)
    torch.manual_seed(1)
    first = solve(game, x0, theta)
    torch.manual_seed(2)
    second = solve(game, x0, theta)
    for name in Extremal._fields:
        one, two = getattr(first, name), getattr(second, name)
        assert torch.equal(one.nan_to_num(7), two.nan_to_num(7)), name


def test_rows_do_not_influence_each_other():
    game = make("narrow_road")
    x0, theta = starts(game, 3), torch.tensor([[1.0, 1.0], [5.0, 1.0], [3.0, 5.0]], dtype=torch.float64)
    together = solve(game, x0, theta)
    alone = join([solve(game, x0[row : row + 1], theta[row : row + 1]) for row in range(3)])
    chunked = solve(game, x0, theta, Solver(chunk=2))
    for found in (alone, chunked):
        torch.testing.assert_close(found.x, together.x, rtol=0, atol=1e-7)
        torch.testing.assert_close(found.value, together.value, rtol=0, atol=1e-6)


def test_the_game_itself_is_left_alone():
    game = make("drone")
    solve(game, starts(game, 1), types(1, 1, 1))
    assert game.state_box.lo.dtype == torch.float32


@pytest.mark.parametrize(
    ("x0", "theta", "message"),
    [
        (torch.zeros(2, 4), torch.ones(2, 2), r"x0 must have shape \(B, 2, 4\).*got \(2, 4\)"),
        (torch.zeros(3, 2, 5), torch.ones(3, 2), r"x0 must have shape \(B, 2, 4\).*got \(3, 2, 5\)"),
        (torch.zeros(3, 3, 4), torch.ones(3, 3), r"x0 must have shape \(B, 2, 4\).*got \(3, 3, 4\)"),
        (torch.zeros(0, 2, 4), torch.ones(0, 2), r"x0 must have shape .* with B > 0; got \(0, 2, 4\)"),
        (torch.zeros(3, 2, 4), torch.ones(2, 2), r"theta must have shape \(3, 2\), a type per player; got \(2, 2\)"),
        (torch.zeros(3, 2, 4), torch.ones(3), r"theta must have shape \(3, 2\), a type per player; got \(3,\)"),
        (torch.full((3, 2, 4), torch.nan), torch.ones(3, 2), r"x0 has entries that are not finite, first in row 0"),
        (torch.zeros(3, 2, 4), torch.tensor([[1, 1], [1, torch.inf], [1, 1]]), r"theta has entries .* in row 1"),
    ],
)
def test_unusable_input_is_refused_by_name(x0, theta, message):
    with pytest.raises(ValueError, match=message):
        solve(make("narrow_road"), x0, theta)


class NotANumber(LinearQuadratic):
    """Dynamics that are undefined everywhere."""

    def dynamics(self, x: Tensor, u: Tensor) -> Tensor:
        return super().dynamics(x, u) * torch.nan


class UndefinedFarAway(LinearQuadratic):
    """Dynamics that are undefined where the first state exceeds 1."""

    def dynamics(self, x: Tensor, u: Tensor) -> Tensor:
        return super().dynamics(x, u) + (1 - x[..., :1]).sqrt() * 0


class FiniteEscape(LinearQuadratic):
    """x' = x^2 + u: from 5 and with |u| <= 1, the state is infinite after 0.2 s, so nothing solves 1 s."""

    def __init__(self) -> None:
        one = torch.ones(2, 1, 1, dtype=torch.float64)
        form = torch.eye(2, dtype=torch.float64).expand(2, 2, 2)
        super().__init__(0 * one, one, one[..., 0], form, form, reach=1.0)
        self.initial_box = Box([[4.5], [4.5]], [[5.0], [5.0]])
        self.state_box = Box([[-9.0], [-9.0]], [[9.0], [9.0]])

    def dynamics(self, x: Tensor, u: Tensor) -> Tensor:
        return x.square() + u


def variant(kind: type[LinearQuadratic]) -> LinearQuadratic:
    game = random_game(2)
    return kind(game.a, game.b, game.r, game.q, game.s).double()


def test_dynamics_that_are_not_finite_are_a_status():
    game = variant(NotANumber)
    found = solve(game, starts(game, 2), torch.zeros(2, 2))
    assert found.status.tolist() == [Status.NOT_FINITE] * 2
    assert found.alternatives.isnan().all()
    assert (found.residual == torch.inf).all()


def test_a_bad_row_does_not_spoil_its_neighbours():
    game, sound = variant(UndefinedFarAway), random_game(2)
    x0 = 0.1 * starts(game, 3)
    x0[1, 0, 0] = 2.0
    found, exact = solve(game, x0, torch.zeros(3, 2)), solve(sound, x0, torch.zeros(3, 2))
    assert (found.status == Status.CONVERGED).tolist() == [True, False, True]
    torch.testing.assert_close(found.x[[0, 2]], exact.x[[0, 2]], rtol=0, atol=1e-7)


def test_a_problem_without_solution_is_a_status():
    game = FiniteEscape().double()
    found = solve(game, starts(game, 2), torch.zeros(2, 2))
    assert (found.status != Status.CONVERGED).all()
    assert (found.residual > 1e-6).all()


def test_too_few_newton_steps_are_a_status():
    game = make("narrow_road")
    settings = Solver()._replace(newton=Solver().newton._replace(steps=1))
    found = solve(game, starts(game, 2), types(2, 5, 5), settings)
    assert found.status.tolist() == [Status.MAX_STEPS] * 2
    assert (found.residual > settings.newton.tolerance).all()
