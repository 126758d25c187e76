"""Solving from the middle of a game: time consistency against exact solutions, warm starts, and what failures leave."""

from __future__ import annotations

import math

import pytest
import torch

from hno.games import make
from hno.games.base import own_costate
from hno.pontryagin import Solver, solve
from hno.pontryagin.collocation import Collocation
from hno.pontryagin.newton import Newton
from hno.pontryagin.online import first_plan, planned_control, remaining, replan, subgame
from hno.types import Status
from tests.lq import open_loop_nash, random_game
from tests.pontryagin.encounters import FIRST, starts, types
from tests.walkers import Walkers

HOPELESS = Solver(newton=Newton(tolerance=0.0, steps=2, full_steps=1))
"""Newton moves, but nothing is good enough."""


def exact_at(game, x0, t):
    """The exact equilibrium of a linear-quadratic game at one time: state, own costate and control."""
    found = open_loop_nash(game, x0, torch.tensor([t], dtype=torch.float64))
    return found.x[:, 0], own_costate(found.costate)[:, 0], found.u[:, 0]


@pytest.mark.parametrize("tau", [0.5, 0.137, 0.02])
@pytest.mark.parametrize("players", [2, 3])
def test_the_rest_of_an_open_loop_equilibrium_solves_the_rest_of_the_game(players, tau):
    """Open-loop equilibria are time consistent along themselves; label steps need not divide what remains."""
    game = random_game(players)
    x0 = starts(game, 2)
    state = exact_at(game, x0, 1 - tau)[0]
    found = solve(subgame(game, tau), state, torch.zeros(2, players))
    rest = open_loop_nash(game, x0, 1 - tau + found.t)
    assert found.status.tolist() == [Status.CONVERGED] * 2
    assert float(found.t[-1]) == tau
    for name in rest._fields:
        torch.testing.assert_close(getattr(found, name), getattr(rest, name), rtol=0, atol=1e-7, msg=name)


@pytest.mark.parametrize("players", [2, 3])
def test_plans_follow_the_exact_equilibrium_to_the_last_step(players):
    game = random_game(players)
    x0, theta = starts(game, 2), torch.zeros(2, players, dtype=torch.float64)
    plan = first_plan(game, x0, theta)
    for t in (0.037, 0.4, 0.75, 0.98):
        state, own, u = exact_at(game, x0, t)
        rest = subgame(game, 1 - t)
        torch.testing.assert_close(planned_control(rest, plan.at), u, rtol=0, atol=1e-6)
        plan = replan(rest, state, plan.at)
        assert not bool((plan.searched | plan.failed).any())
        torch.testing.assert_close(plan.at.z[:, 0], torch.cat([state, own], -2).flatten(-2), rtol=0, atol=1e-7)
        torch.testing.assert_close(planned_control(rest, plan.at), u, rtol=0, atol=1e-7)
        assert float(plan.at.t[0, -1]) == 1 - t


def test_the_rest_of_a_label_solves_the_rest_of_its_game():
    game, theta = make("narrow_road"), types(2, 1, 5)
    label = solve(game, starts(game, 2), theta)
    found = solve(subgame(game, 2.3), label.x[:, 7], theta)
    assert found.status.tolist() == [Status.CONVERGED] * 2
    torch.testing.assert_close(found.x, label.x[:, 7:], rtol=0, atol=1e-3)
    torch.testing.assert_close(found.u, label.u[:, 7:], rtol=0, atol=1e-2)
    torch.testing.assert_close(found.value, label.value[:, 7:], rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("name", FIRST)
def test_a_warm_start_finds_what_a_search_finds(name):
    """Where players have left their plan a little, Newton from the rest of the plan needs no search."""
    game, theta = make(name).double(), types(2, 1, 1)
    plan, rest = first_plan(game, starts(game, 2), theta), subgame(game, game.horizon - 0.5)
    planned = Collocation(game).split(remaining(rest, plan.at, 0).z[:, 0])[0]
    nudge = torch.randn(planned.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    x = planned + 0.002 * game.state_box.width * nudge
    warm, cold = replan(rest, x, plan.at), first_plan(rest, x, theta)
    assert not bool((warm.searched | warm.failed | cold.failed).any())
    now, expected = warm.at.z[:, 0], cold.at.z[:, 0]
    torch.testing.assert_close(now, expected, rtol=1e-4, atol=1e-3)
    assert torch.equal(now[:, : now.shape[-1] // 2], x.flatten(1))


def test_a_useless_plan_is_replaced_by_a_search_in_its_own_row():
    game, theta = Walkers().double(), types(3, 1, 1)
    x0 = starts(game, 3)
    plan = first_plan(game, x0, theta)
    plan.at.z[1] = torch.nan
    found, cold = replan(game, x0, plan.at), first_plan(game, x0, theta)
    assert found.searched.tolist() == [False, True, False]
    assert not bool(found.failed.any())
    torch.testing.assert_close(planned_control(game, found.at), planned_control(game, cold.at), rtol=0, atol=1e-6)


def test_what_is_not_solved_follows_its_last_plan():
    game, theta = Walkers().double(), types(2, 1, 1)
    x0 = starts(game, 2)
    plan = first_plan(game, x0, theta)
    rest, later = subgame(game, 0.8), subgame(game, 0.23)
    elsewhere = x0 + torch.tensor([1.0, 0.5])
    kept = replan(rest, elsewhere, plan.at, HOPELESS)
    assert kept.failed.all()
    assert kept.searched.all()
    for moment in (rest, later):
        u = planned_control(moment, plan.at)
        torch.testing.assert_close(planned_control(moment, kept.at), u, rtol=0, atol=1e-3)
    solved = replan(rest, elsewhere, kept.at)
    assert not bool(solved.failed.any())
    assert float((planned_control(rest, solved.at) - planned_control(rest, plan.at)).abs().max()) > 0.1


def test_a_first_plan_that_is_not_solved_is_the_best_attempt():
    game, theta = Walkers().double(), types(2, 1, 1)
    plan = first_plan(game, starts(game, 2), theta, HOPELESS)
    assert plan.failed.all()
    assert bool(planned_control(game, plan.at).isfinite().all())


@pytest.mark.parametrize("name", FIRST)
def test_one_control_step_is_a_game_too(name):
    game, theta = make(name), types(1, 1, 1)
    found = solve(subgame(game, 0.02), starts(game, 1), theta)
    assert found.status.tolist() == [Status.CONVERGED]
    assert found.t.tolist() == [0, 0.02]
    assert bool((found.local_gap < 1e-6).all())


@pytest.mark.parametrize("tau", [0.0, -1.0, 3.1, math.nan, math.inf])
def test_there_is_no_rest_of_a_game_outside_its_time(tau):
    with pytest.raises(ValueError, match="positive and at most the horizon of 3 s"):
        subgame(make("narrow_road"), tau)


def test_the_game_itself_is_left_alone():
    game = make("narrow_road")
    assert subgame(game, 1.0).horizon == 1.0
    assert game.horizon == 3.0
    assert game.state_box.lo.dtype == torch.float32


def test_states_that_are_not_finite_are_failures():
    game, theta = Walkers().double(), types(2, 1, 1)
    x = starts(game, 2)
    x[1] = torch.nan
    plan = first_plan(game, x, theta)
    assert plan.failed.tolist() == [False, True]
    assert replan(subgame(game, 0.9), x, plan.at).failed.tolist() == [False, True]
