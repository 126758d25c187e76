from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from hno.evaluation.rollout import rollout
from hno.games import Game, make
from hno.types import Extremal, Trajectory
from tests.walkers import Walkers

GAMES = ("narrow_road", "lane_change", "drone")


def steady(game: Game, u: Tensor) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
    """A policy that plays one control (P, m) whatever happens."""
    return lambda tau, x, theta: u.to(x).expand(len(x), -1, -1)


def walk(first: list[float], second: list[float], velocity: float = 4.0, dt: float = 0.02) -> Trajectory:
    """Two walkers straight along x from their own starts."""
    game = Walkers().double()
    x0 = torch.tensor([[first, second]], dtype=torch.float64)
    u = torch.tensor([[velocity, 0.0]] * 2)
    return rollout(game, steady(game, u), x0, torch.ones(1, 2, dtype=torch.float64), dt)


def test_straight_motion_keeps_the_distance_of_geometry() -> None:
    played = walk([0.0, 0.25], [0.0, 0.25])
    assert played.distance.item() == pytest.approx(0.5, abs=1e-4)
    assert played.clearance.item() == pytest.approx(0.5 - 0.4, abs=1e-4)
    torch.testing.assert_close(played.x[0, -1, :, 0], torch.full((2,), 4.0, dtype=torch.float64))
    assert len(played.t) == 51
    assert played.u.shape == (1, 50, 2, 2)


def test_value_of_straight_motion_is_the_integral_of_the_running_cost() -> None:
    played = walk([0.0, 0.9], [0.0, 0.9])
    t = torch.linspace(0, 1, 20001, dtype=torch.float64)
    gap = torch.stack([4 - 8 * t, torch.full_like(t, 1.8)], -1).norm(dim=-1)
    penalty = torch.trapezoid(1e4 * torch.sigmoid(5 * (0.4 - gap)), t)
    assert -played.value[0, 0].item() == pytest.approx(16 + penalty.item() + 0.81, rel=1e-5)


@pytest.mark.parametrize("lateral", [0.0, 0.3, 0.79])
def test_a_collision_between_two_samples_is_found(lateral: float) -> None:
    """At 12 m/s of closing speed and 0.2 s a step the walkers are 2.4 m apart before and after they pass."""
    played = walk([-0.8, lateral / 2], [-0.8, lateral / 2], velocity=6.0, dt=0.2)
    first, second = Walkers().double().positions(played.x).unbind(-2)
    at_samples = (first - second).norm(dim=-1)
    assert float(at_samples.min()) > 0.7
    assert played.distance.item() == pytest.approx(lateral, abs=0.12)
    assert bool(played.clearance.item() <= 0) == (lateral < 0.4)


def test_cars_that_pass_between_two_steps_collide() -> None:
    game = make("narrow_road").double()
    closing, lateral = 50.0, 1.45
    meeting = 0.61  # s, half way between two samples
    along = (70 - closing * meeting) / 2
    x0 = torch.tensor([[[along, 4.0 - lateral / 2, 0, 25], [along, 4.0 + lateral / 2, 0, 25]]], dtype=torch.float64)
    played = rollout(game, steady(game, torch.zeros(2, 2)), x0, torch.ones(1, 2, dtype=torch.float64))
    at_samples = -game.constraint(played.x, torch.ones(1, 151, 2, dtype=torch.float64))
    assert float(at_samples.min()) > 0.02
    assert played.distance.item() == pytest.approx(lateral, abs=1e-3)
    assert played.clearance.item() == pytest.approx(lateral - 1.5, abs=1e-3)


def test_smallest_distance_is_over_the_whole_episode_and_per_row() -> None:
    game = Walkers().double()
    x0 = torch.tensor([[[0, y], [0, y]] for y in (0.1, 0.4, -0.7)], dtype=torch.float64)
    played = rollout(game, steady(game, torch.tensor([[4.0, 0]] * 2)), x0, torch.ones(3, 2, dtype=torch.float64))
    torch.testing.assert_close(played.distance, torch.tensor([0.2, 0.8, 1.4], dtype=torch.float64), rtol=0, atol=1e-3)


def test_control_is_held_for_dt_and_asked_for_at_the_right_time() -> None:
    game, asked = Walkers().double(), []

    def policy(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        asked.append((tau.clone(), x.clone(), theta.clone()))
        return torch.stack([torch.cos(7 * tau), tau], -1).unsqueeze(-2).expand(len(x), 2, 2)

    x0 = game.initial_box.sample(3, torch.Generator().manual_seed(0))
    theta = torch.tensor([[1.0, 2.0], [0.0, 4.0], [3.0, 3.0]], dtype=torch.float64)
    played = rollout(game, policy, x0, theta, dt=0.05)
    assert [float(tau[0]) for tau, _, _ in asked] == pytest.approx([1 - 0.05 * k for k in range(20)])
    for k, (_, x, types) in enumerate(asked):
        assert torch.equal(x, played.x[:, k])
        assert torch.equal(types, theta)
    torch.testing.assert_close(played.x.diff(dim=1), 0.05 * played.u, rtol=0, atol=1e-12)


def test_rows_are_played_independently() -> None:
    game, generator = make("drone"), torch.Generator().manual_seed(0)
    x0, theta = game.initial_box.sample(4, generator), game.type_box.sample(4, generator)

    def policy(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        return game.control_box.clamp(game.control_box.lo + x[..., :3].abs() * 0.1)

    whole = rollout(game, policy, x0, theta, dt=0.5)
    for row in range(4):
        alone = rollout(game, policy, x0[row : row + 1], theta[row : row + 1], dt=0.5)
        torch.testing.assert_close(alone.x[0], whole.x[row])
        torch.testing.assert_close(alone.value[0], whole.value[row])


def replay(found: Extremal, game: Game) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
    """The controls of labels as a policy; each is held where the middle of its interval would be."""
    step = game.label_step

    def policy(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        t = game.horizon - float(tau[0]) + 0.01
        node = min(int(t / step), len(found.t) - 2)
        return torch.lerp(found.u[:, node], found.u[:, node + 1], t / step - node)

    return policy


@pytest.mark.parametrize("name", GAMES)
def test_replayed_labels_cost_what_the_labels_say(labels: Callable[..., Extremal], name: str) -> None:
    game, found = make(name).double(), labels(name)
    played = rollout(game, replay(found, game), found.x[:, 0], found.theta)
    torch.testing.assert_close(played.value, found.value[:, 0], rtol=0.02, atol=0.01)
    torch.testing.assert_close(played.clearance, found.clearance, rtol=0, atol=0.01)
    box = game.state_box
    assert float(((played.x[:, ::5] - found.x) / box.width).abs().max()) < 0.06


def test_drones_are_driven_by_their_own_controls_each_in_its_own_axis() -> None:
    """Published defect 3: player 2's vy was driven by player 1's angle, and z had a wrong offset."""
    game = make("drone").double()
    u = torch.tensor([[0.0, 0.0, 9.81 + 1.0], [0.03, -0.04, 9.81]], dtype=torch.float64)
    x0 = torch.zeros(1, 2, 6, dtype=torch.float64)
    played = rollout(game, steady(game, u), x0, torch.ones(1, 2, dtype=torch.float64))
    last = played.x[0, -1]
    expected = torch.tensor([[0, 0, 8, 0, 0, 4], [0, 0, 0, 0, 0, 0]], dtype=torch.float64)
    speed = 4 * 9.81 * torch.tensor([math.tan(0.03), math.tan(0.04)], dtype=torch.float64)
    expected[1, 3:5], expected[1, :2] = speed, speed * 2
    torch.testing.assert_close(last, expected)


def test_a_broken_policy_is_not_safe() -> None:
    game = Walkers()
    x0 = torch.zeros(1, 2, 2)
    played = rollout(game, steady(game, torch.full((2, 2), torch.nan)), x0, torch.ones(1, 2))
    assert not bool(played.clearance > 0)


@pytest.mark.parametrize("dt", [0.0, -0.1, 0.3, 2.0, math.nan, math.inf])
def test_dt_must_divide_the_horizon(dt: float) -> None:
    game = Walkers()
    with pytest.raises(ValueError, match="divides the horizon of 1 s"):
        rollout(game, steady(game, torch.zeros(2, 2)), torch.zeros(1, 2, 2), torch.ones(1, 2), dt)
