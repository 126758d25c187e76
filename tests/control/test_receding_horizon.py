"""The controller that solves the rest of the game again and again."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from hno.control.receding_horizon import ONLINE, RecedingHorizon
from hno.control.rollout import Disturbance, rollout
from hno.games import make
from hno.pontryagin import Solver
from hno.pontryagin.newton import Newton
from hno.types import Trajectory
from tests.lq import open_loop_nash, random_game
from tests.walkers import Walkers

COARSE = Solver(newton=Newton(tolerance=1e-6), extra_nodes=0)
HOPELESS = Solver(newton=Newton(tolerance=0.0, steps=2, full_steps=1), extra_nodes=0)


def walkers(count: int) -> tuple[Tensor, Tensor]:
    return Walkers().initial_box.sample(count, torch.Generator().manual_seed(0)), torch.ones(count, 2)


def played(policy: RecedingHorizon, count: int = 2, dt: float = 0.2, noise: float = 0.0) -> Trajectory:
    return rollout(Walkers(), policy, *walkers(count), dt, disturbance=Disturbance(noise))


def times(tau: float, rows: int) -> Tensor:
    return torch.full((rows,), tau)


@pytest.mark.parametrize(("players", "interval"), [(2, 1), (2, 5), pytest.param(3, 1, marks=pytest.mark.slow)])
def test_without_disturbance_it_plays_the_open_loop_equilibrium(players: int, interval: int) -> None:
    """What holding the controls costs is of the first order in the control step."""
    game = random_game(players)
    x0 = game.initial_box.sample(2, torch.Generator().manual_seed(0)).double()
    theta, errors = torch.zeros(2, players, dtype=torch.float64), []
    for dt in (0.05, 0.025):
        policy = RecedingHorizon(game, interval, COARSE)
        found = rollout(game, policy, x0, theta, dt)
        errors.append(float((found.x - open_loop_nash(game, x0, found.t).x).abs().max()))
        assert policy.solves.tolist() == [-(-(len(found.t) - 1) // interval)] * 2
        assert not bool((policy.searches + policy.failures).any())
    assert 1.8 < errors[0] / errors[1] < 2.3
    assert errors[1] < 0.1


def test_it_keeps_walkers_apart_and_answers_to_noise() -> None:
    policy = RecedingHorizon(Walkers())
    calm, shaken = played(policy, 6), played(RecedingHorizon(Walkers()), 6, noise=0.1)
    assert bool((calm.clearance > 0).all())
    assert bool((shaken.clearance > 0).all())
    assert not bool(policy.failures.any())


def test_the_same_call_gives_the_same_controls() -> None:
    torch.manual_seed(1)
    first = played(RecedingHorizon(Walkers()), noise=0.2)
    torch.manual_seed(2)
    with torch.inference_mode():
        second = played(RecedingHorizon(Walkers()), noise=0.2)
    assert all(map(torch.equal, first, second))


def test_chunks_change_nothing() -> None:
    whole, parts = RecedingHorizon(Walkers()), RecedingHorizon(Walkers(), settings=ONLINE._replace(chunk=2))
    torch.testing.assert_close(played(whole, 3).x, played(parts, 3).x, rtol=0, atol=1e-5)
    assert torch.equal(whole.solves, parts.solves)


def test_between_solves_the_plan_is_followed_wherever_the_players_are() -> None:
    x0, theta = walkers(2)
    calm, pushed = RecedingHorizon(Walkers(), 3), RecedingHorizon(Walkers(), 3)
    controls = [
        [policy(times(1 - 0.1 * k, 2), x0 + push * (k > 0), theta) for k in range(4)]
        for policy, push in ((calm, 0.0), (pushed, 0.1))
    ]
    same = [torch.equal(one, two) for one, two in zip(*controls, strict=True)]
    assert same == [True, True, True, False]
    assert not torch.equal(controls[0][0], controls[0][1])


def test_a_failed_solve_is_counted_and_the_last_plan_followed() -> None:
    game, (x0, theta) = Walkers(), walkers(2)
    policy, patient = RecedingHorizon(game), RecedingHorizon(game, interval=10)
    for k in range(4):
        u, planned = policy(times(1 - 0.1 * k, 2), x0, theta), patient(times(1 - 0.1 * k, 2), x0, theta)
        torch.testing.assert_close(u, planned, rtol=0, atol=1e-3)
        policy.settings = HOPELESS
    assert policy.solves.tolist() == [4, 4]
    assert policy.searches.tolist() == policy.failures.tolist() == [3, 3]
    assert patient.solves.tolist() == [1, 1]


@pytest.mark.slow
def test_without_any_solution_the_failures_are_all_there() -> None:
    policy = RecedingHorizon(Walkers(), settings=HOPELESS)
    found = played(policy)
    assert policy.failures.tolist() == policy.solves.tolist() == [5, 5]
    assert bool(found.u.isfinite().all())


def test_one_instance_drives_one_batch_of_episodes() -> None:
    x0, theta = walkers(2)
    policy = RecedingHorizon(Walkers())
    with pytest.raises(ValueError, match=r"one time to go; got 0.5 to 1 s"):
        policy(torch.tensor([1.0, 0.5]), x0, theta)
    policy(times(1.0, 2), x0, theta)
    with pytest.raises(ValueError, match=r"must fall from call to call; got 1 s after 1 s"):
        policy(times(1.0, 2), x0, theta)
    for rows, types in ((1, theta[:1]), (2, 2 * theta)):
        with pytest.raises(ValueError, match="one batch of episodes"):
            policy(times(0.9, rows), x0[:rows], types)
    with pytest.raises(ValueError, match="at least 1 control step; got 0"):
        RecedingHorizon(make("drone"), 0)
