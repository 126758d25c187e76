"""The solver against exact solutions of linear-quadratic games, and what it does when there is no solution."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from hno.games import Box, make
from hno.games.base import own_costate
from hno.pontryagin import Solver, solve
from hno.pontryagin.newton import Newton
from hno.types import Extremal, Status, join
from tests.games.test_contract import FreeEncounter
from tests.lq import LinearQuadratic, open_loop_nash, open_loop_riccati, random_game
from tests.pontryagin.encounters import starts, types

QUICK = Solver(newton=Newton(steps=12, full_steps=4), extra_nodes=12)
"""Gives up soon."""
FINE = Solver(extra_nodes=300)
"""Errors fall with the fourth power of the mesh width: this is fine enough for 1e-8."""
MESHES = pytest.mark.parametrize(
    ("settings", "tolerance"),
    [(Solver(), 1e-7), pytest.param(FINE, 1e-8, marks=pytest.mark.slow)],
    ids=["default", "fine"],
)


@MESHES
@pytest.mark.parametrize(("players", "seed"), [(2, 0), (3, 1)])
def test_general_sum_equilibrium_is_the_exact_one(players, seed, settings, tolerance):
    """States, controls, own and cross costates and values, with different costs for every player."""
    game = random_game(players, seed=seed)
    x0 = starts(game, 4)
    found = solve(game, x0, torch.zeros(4, players), settings)
    exact = open_loop_nash(game, x0, found.t)
    assert found.status.tolist() == [Status.CONVERGED] * 4
    for name in exact._fields:
        torch.testing.assert_close(getattr(found, name), getattr(exact, name), rtol=0, atol=tolerance, msg=name)


@MESHES
@pytest.mark.parametrize("players", [2, 3])
def test_initial_own_costates_follow_the_coupled_riccati_equations(players, settings, tolerance):
    game = random_game(players, seed=2)
    x0 = starts(game, 4)
    found = solve(game, x0, torch.zeros(4, players), settings)
    exact = torch.einsum("pab,rb->rpa", -2 * open_loop_riccati(game), x0.flatten(-2)).unflatten(-1, (players, 2))
    torch.testing.assert_close(own_costate(found.costate[:, 0]), own_costate(exact), rtol=0, atol=tolerance)


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


@pytest.mark.slow
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


@pytest.mark.slow
def test_inference_mode_changes_nothing():
    game, theta = make("narrow_road"), types(2, 1, 5)
    x0 = starts(game, 2)
    outside = solve(game, x0, theta)
    with torch.inference_mode():
        inside = solve(make("narrow_road"), x0.clone(), theta.clone())
    for name in Extremal._fields:
        assert torch.equal(getattr(outside, name).nan_to_num(7), getattr(inside, name).nan_to_num(7)), name


@pytest.mark.slow
def test_rows_do_not_influence_each_other():
    game = make("narrow_road")
    x0, theta = starts(game, 3), torch.tensor([[1.0, 1.0], [5.0, 1.0], [3.0, 5.0]], dtype=torch.float64)
    together = solve(game, x0, theta)
    alone = join([solve(game, x0[row : row + 1], theta[row : row + 1]) for row in range(3)])
    chunked = solve(game, x0, theta, Solver(chunk=2))
    for found in (alone, chunked):
        torch.testing.assert_close(found.x, together.x, rtol=0, atol=1e-7)
        torch.testing.assert_close(found.value, together.value, rtol=0, atol=1e-6)


def test_states_and_controls_come_in_one_batch_shape():
    """These dynamics concatenate them, which does not broadcast."""
    game = FreeEncounter()
    x0 = torch.tensor([[[-1.0, 0.1, 0, 0], [1, 0, 0, 0]]], dtype=torch.float64)
    assert solve(game, x0, types(1, 1, 1)).status.tolist() == [Status.CONVERGED]


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
    found = solve(game, starts(game, 2), torch.zeros(2, 2), QUICK)
    assert found.status.tolist() == [Status.NOT_FINITE] * 2
    assert found.alternatives.isnan().all()
    assert (found.residual == torch.inf).all()


def test_a_bad_row_does_not_spoil_its_neighbours():
    game, sound = variant(UndefinedFarAway), random_game(2)
    x0 = 0.1 * starts(game, 3)
    x0[1, 0, 0] = 2.0
    found, exact = (solve(one, x0, torch.zeros(3, 2), QUICK) for one in (game, sound))
    assert (found.status == Status.CONVERGED).tolist() == [True, False, True]
    torch.testing.assert_close(found.x[[0, 2]], exact.x[[0, 2]], rtol=0, atol=1e-7)


def test_a_problem_without_solution_is_a_status():
    game = FiniteEscape().double()
    found = solve(game, starts(game, 2), torch.zeros(2, 2), QUICK)
    assert (found.status != Status.CONVERGED).all()
    assert (found.residual > 1e-6).all()


def test_too_few_newton_steps_are_a_status():
    game = make("narrow_road")
    settings = Solver()._replace(newton=Solver().newton._replace(steps=1, reuses=0))
    found = solve(game, starts(game, 2), types(2, 5, 5), settings)
    assert found.status.tolist() == [Status.MAX_STEPS] * 2
    assert (found.residual > settings.newton.tolerance).all()
