from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from hno.control.rollout import Disturbance, Policy, rollout
from hno.games import Game, make
from hno.pontryagin.threads import torch_threads
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


@pytest.mark.parametrize("name", ["narrow_road", pytest.param("lane_change", marks=pytest.mark.slow), "drone"])
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


@pytest.mark.parametrize("name", [*GAMES, "intersection"])
def test_a_constraint_is_evaluated_once_a_step(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Clearance and penalty share it; costs are the same as those of a game that states the same penalty itself."""
    game, calls = make(name), list[Tensor]()
    constraint = type(game).constraint
    monkeypatch.setattr(type(game), "constraint", lambda self, x, theta: calls.append(x) or constraint(self, x, theta))
    x0, theta = game.initial_box.sample(3, torch.Generator().manual_seed(0)), torch.ones(3, game.players)
    played = rollout(game, feedback(game), x0, theta, dt=0.5)
    assert len(calls) == round(game.horizon / 0.5)
    monkeypatch.setattr(type(game), "penalty", type(game).penalty if name == "intersection" else own_penalty)
    assert torch.equal(rollout(game, feedback(game), x0, theta, dt=0.5).value, played.value)


def own_penalty(game: Game, x: Tensor, theta: Tensor) -> Tensor:
    """The default, stated again."""
    return game.soft_constraint(game.constraint(x, theta)).sum(-1)


@pytest.mark.parametrize("dt", [0.0, -0.1, 0.3, 2.0, math.nan, math.inf])
def test_dt_must_divide_the_horizon(dt: float) -> None:
    game = Walkers()
    with pytest.raises(ValueError, match="divides the horizon of 1 s"):
        rollout(game, steady(game, torch.zeros(2, 2)), torch.zeros(1, 2, 2), torch.ones(1, 2), dt)


def feedback(game: Game) -> Policy:
    """A policy that depends on everything it is told, within the control box."""

    def policy(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        lean = torch.sin(3 * x.sum(-1) + 5 * tau.unsqueeze(-1) + theta).unsqueeze(-1)
        box = game.control_box
        return (box.lo + box.hi) / 2 + box.width / 2 * lean * torch.linspace(0.3, 1, game.control_dim, dtype=x.dtype)

    return policy


def episodes(name: str, disturbance: Disturbance, policy: Policy | None = None, count: int = 3) -> Trajectory:
    game = make(name).double()
    generator = torch.Generator().manual_seed(4)
    x0, theta = game.initial_box.sample(count, generator), game.type_box.sample(count, generator)
    return rollout(game, policy or feedback(game), x0, theta, dt=0.1, disturbance=disturbance)


@pytest.mark.parametrize("name", GAMES)
@pytest.mark.parametrize("disturbance", [Disturbance(), Disturbance(0.0, 0, 7)])
def test_no_disturbance_changes_nothing(name: str, disturbance: Disturbance) -> None:
    game = make(name).double()
    generator = torch.Generator().manual_seed(4)
    x0, theta = game.initial_box.sample(3, generator), game.type_box.sample(3, generator)
    assert all(map(torch.equal, episodes(name, disturbance), rollout(game, feedback(game), x0, theta, dt=0.1)))


@pytest.mark.parametrize("delay", [1, 3, 29, 30, 100])
def test_a_delay_applies_older_answers(delay: int) -> None:
    """Until the first answer comes it is applied in advance; what is asked is the state of now."""
    game, answers, states = make("narrow_road").double(), list[Tensor](), list[Tensor]()

    def policy(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        states.append(x.clone())
        answers.append(feedback(game)(tau, x, theta))
        return answers[-1].clone()

    played = episodes("narrow_road", Disturbance(delay=delay), policy)
    assert len(answers) == 30
    for k in range(30):
        assert torch.equal(played.u[:, k], answers[max(0, k - delay)])
        assert torch.equal(states[k], played.x[:, k])
    undisturbed = episodes("narrow_road", Disturbance())
    assert torch.equal(played.u[:, :1], undisturbed.u[:, :1])
    assert not torch.equal(played.u[:, 1:], undisturbed.u[:, 1:])


def test_a_delay_shifts_what_depends_on_time_alone() -> None:
    game = make("drone").double()

    def clock(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        box = game.control_box
        return (box.lo + box.width * (tau / game.horizon).unsqueeze(-1)).unsqueeze(1).expand(-1, 2, -1)

    now, late = (episodes("drone", Disturbance(delay=delay), clock).u for delay in (0, 4))
    assert torch.equal(late[:, 4:], now[:, :-4])
    assert torch.equal(late[:, :4], now[:, :1].expand(-1, 4, -1, -1))


@pytest.mark.parametrize("name", GAMES)
@pytest.mark.parametrize("noise", [0.05, 10.0])
def test_noise_stays_admissible(name: str, noise: float) -> None:
    box = make(name).double().control_box
    u = episodes(name, Disturbance(noise)).u
    assert bool(((box.lo <= u) & (u <= box.hi)).all())
    outside = episodes(name, Disturbance(noise), lambda tau, x, theta: box.hi.expand(len(x), 2, -1)).u
    assert bool((outside <= box.hi).all())
    assert bool((outside < box.hi).any())


def test_noise_is_new_for_every_step_player_control_and_row() -> None:
    game = make("drone").double()
    middle = (game.control_box.lo + game.control_box.hi) / 2
    u = episodes("drone", Disturbance(0.01), steady(game, middle.expand(2, -1)), count=200).u
    noise = (u - middle) / (game.control_box.width / 2)
    assert len(noise.flatten().unique()) == noise.numel()
    assert noise.mean().item() == pytest.approx(0, abs=2e-4)
    torch.testing.assert_close(noise.std(dim=(0, 1, 2)), torch.full((3,), 0.01, dtype=torch.float64), rtol=0.03, atol=0)
    assert torch.corrcoef(torch.stack([noise[:, :-1].flatten(), noise[:, 1:].flatten()]))[0, 1].abs() < 0.02
    assert torch.corrcoef(torch.stack([noise[:, :, 0].flatten(), noise[:, :, 1].flatten()]))[0, 1].abs() < 0.02


def test_noise_is_a_function_of_its_seed() -> None:
    torch.manual_seed(1)
    first = episodes("lane_change", Disturbance(0.1, 1, seed=3))
    state = torch.random.get_rng_state()
    torch.manual_seed(2)
    again, other = (episodes("lane_change", Disturbance(0.1, 1, seed=seed)) for seed in (3, 4))
    assert all(map(torch.equal, first, again))
    assert not torch.equal(first.u[:, 0], other.u[:, 0])
    torch.manual_seed(1)
    assert torch.equal(torch.random.get_rng_state(), state), "the global generator is left alone"


def test_delay_and_noise_together_disturb_the_older_answer() -> None:
    game = Walkers().double()
    steps = iter(range(100))

    def counting(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        return torch.full((len(x), 2, 2), 0.1 * next(steps), dtype=torch.float64)

    x0, theta = torch.linspace(0, 1, 200).double().view(50, 2, 2), torch.ones(50, 2, dtype=torch.float64)
    played = rollout(game, counting, x0, theta, 0.05, disturbance=Disturbance(1e-3, 2))
    wanted = 0.1 * torch.tensor([max(0, k - 2) for k in range(20)], dtype=torch.float64)
    error = played.u - wanted[:, None, None]
    assert error.abs().max().item() < 6e-3 * 5
    assert error.std().item() == pytest.approx(6e-3, rel=0.1)


def test_a_broken_policy_is_not_safe_under_noise() -> None:
    game = Walkers()
    x0 = torch.zeros(1, 2, 2)
    broken = steady(game, torch.full((2, 2), torch.nan))
    played = rollout(game, broken, x0, torch.ones(1, 2), disturbance=Disturbance(0.1, 1))
    assert not bool(played.clearance > 0)


def test_policies_are_asked_about_finite_states_alone() -> None:
    """An episode that floating point cannot hold is a collision; the others go on as without it."""
    game, x0, theta = Walkers(), torch.tensor([[[0.0, 0.9], [0.0, 0.9]]]).repeat(2, 1, 1), torch.ones(2, 2)

    def strict(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        assert x.isfinite().all()
        u = torch.tensor([4.0, 0.0]).repeat(len(x), 2, 1)
        u[1:, 0, 0] = 3e38
        return u

    played, alone = rollout(game, strict, x0, theta, 0.1), rollout(game, strict, x0[:1], theta[:1], 0.1)
    assert (played.clearance > 0).tolist() == [True, False]
    assert torch.equal(played.x[:1], alone.x)
    assert torch.equal(played.value[:1], alone.value)
    pushed = rollout(game, strict, x0, theta, 0.1, disturbance=Disturbance(drift=1e38, belief=0.5))
    assert pushed.u[:, -1].isnan().all()


def test_a_rollout_uses_one_thread_and_leave_the_setting_as_it_was() -> None:
    game, seen = Walkers().double(), []

    def policy(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        seen.append(torch.get_num_threads())
        return x * 0

    x0, theta = game.initial_box.sample(1, torch.Generator().manual_seed(0)), torch.ones(1, 2, dtype=torch.float64)
    with torch_threads(3):
        rollout(game, policy, x0, theta, dt=0.5)
        rollout(game, policy, x0, theta, dt=0.5, threads=2)
        assert torch.get_num_threads() == 3
    assert seen == [1, 1, 2, 2]
