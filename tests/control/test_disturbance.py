"""What stands between a policy and the game: each episode has its own, whoever is played beside it."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from hno.control.disturbance import believed, normal, state_push
from hno.control.rollout import Disturbance, Policy, rollout
from hno.games import Game, make
from hno.types import Trajectory
from tests.walkers import Walkers

EVERYTHING = Disturbance(noise=0.1, delay=2, seed=3, drift=0.05, gusts=0.02, belief=0.25)
GAMES = ("narrow_road", "lane_change", "drone")


def starts(game: Game, count: int, seed: int = 4) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return game.initial_box.sample(count, generator), game.type_box.sample(count, generator)


def leaning(game: Game) -> Policy:
    """A policy that depends on everything it is told."""

    def policy(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        lean = torch.sin(3 * x.sum(-1) + 5 * tau.unsqueeze(-1) + theta + 2 * theta.flip(-1)).unsqueeze(-1)
        return (game.control_box.lo + game.control_box.hi + 0.9 * game.control_box.width * lean) / 2

    return policy


def still(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
    return torch.zeros(len(x), 2, 2, dtype=x.dtype)


def equal(one: Trajectory, other: Trajectory) -> bool:
    return all(torch.allclose(a, b, rtol=1e-10, atol=1e-12) for a, b in zip(one, other, strict=True))


def rows(played: Trajectory, chosen: Tensor) -> Trajectory:
    return Trajectory(played.t, *(column[chosen] for column in played[1:]))


@pytest.mark.parametrize("name", GAMES)
def test_an_episode_does_not_depend_on_those_beside_it(name: str) -> None:
    game = make(name).double()
    x0, theta = starts(game, 7)
    whole = rollout(game, leaning(game), x0, theta, 0.1, disturbance=EVERYTHING)
    for chosen in (torch.tensor([3]), torch.tensor([6, 0, 2])):
        alone = rollout(game, leaning(game), x0[chosen], theta[chosen], 0.1, disturbance=EVERYTHING)
        assert equal(alone, rows(whole, chosen))


def test_starts_in_single_and_double_precision_meet_the_same_numbers() -> None:
    x0, theta = starts(make("drone"), 3)
    single, double = (normal("noise", 0, x0.to(dtype), theta.to(dtype), (4,)) for dtype in (torch.float, torch.double))
    torch.testing.assert_close(single, double.float(), rtol=0, atol=0)


def test_numbers_depend_on_name_seed_start_and_types() -> None:
    x0, theta = starts(make("drone"), 2)
    first = normal("noise", 0, x0, theta, (5, 3))
    assert torch.equal(first, normal("noise", 0, x0, theta, (5, 3)))
    others = [
        normal("gusts", 0, x0, theta, (5, 3)),
        normal("noise", 1, x0, theta, (5, 3)),
        normal("noise", 0, x0 + 1e-3, theta, (5, 3)),
        normal("noise", 0, x0, theta.flip(-1), (5, 3)),
    ]
    assert all(not bool((first == other).any()) for other in others)
    assert not bool((first[0] == first[1]).any())


def test_numbers_are_standard_normal() -> None:
    x0, theta = starts(make("drone"), 2000)
    drawn = normal("drift", 0, x0, theta, (10,))
    assert abs(float(drawn.mean())) < 0.02
    assert float(drawn.std()) == pytest.approx(1, abs=0.02)
    assert abs(float(torch.corrcoef(drawn.mT)[0, 1])) < 0.08
    assert float((drawn.abs() < 1.959964).float().mean()) == pytest.approx(0.95, abs=0.005)


@pytest.mark.parametrize("kind", ["drift", "gusts"])
@pytest.mark.parametrize("dt", [0.02, 0.1])
def test_a_push_moves_what_is_free_by_its_size_over_the_horizon(kind: str, dt: float) -> None:
    """Standing walkers end where the push leads them; white noise of any step has the same size."""
    game = Walkers().double()
    game.horizon = 2.0
    x0, theta = starts(game, 3000)
    played = rollout(game, still, x0, theta, dt, substeps=1, points=1, disturbance=Disturbance(**{kind: 0.1}))
    moved = (played.x[:, -1] - x0) / game.state_box.width
    torch.testing.assert_close(moved.std(0), torch.full((2, 2), 0.1, dtype=torch.float64), rtol=0.05, atol=0)
    assert moved.mean(0).abs().max() < 0.01


def test_a_drift_is_constant_and_gusts_are_white() -> None:
    game = Walkers().double()
    x0, theta = starts(game, 500)
    steady, white = (state_push(game, x0, theta, 20, d) for d in (Disturbance(drift=0.1), Disturbance(gusts=0.1)))
    assert steady is not None
    assert white is not None
    assert steady.shape == white.shape == (500, 20, 2, 2)
    assert torch.equal(steady, steady[:, :1].expand(-1, 20, -1, -1))
    pairs = torch.stack([white[:, :-1].flatten(), white[:, 1:].flatten()])
    assert abs(float(torch.corrcoef(pairs)[0, 1])) < 0.02


def test_only_the_chosen_states_are_pushed() -> None:
    game = make("narrow_road").double()
    x0, theta = starts(game, 5)
    push = state_push(game, x0, theta, 3, Disturbance(drift=0.1, gusts=0.1, components=(2,)))
    assert push is not None
    assert bool((push[..., 2] != 0).all())
    assert not bool(push[..., [0, 1, 3]].any())
    with pytest.raises(ValueError, match=r"places in a player's state, 0 to 3; got \[4\]"):
        state_push(game, x0, theta, 3, Disturbance(drift=0.1, components=(4,)))


def test_beliefs_are_off_by_their_error_inside_the_type_box_but_not_about_oneself() -> None:
    game = make("narrow_road").double()
    theta = torch.tensor([[1.0, 5.0], [3.0, 2.0]], dtype=torch.float64).repeat(200, 1)
    drawn = torch.randn(400, 2, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    estimates = believed(game, theta, drawn, 0.25)
    assert torch.equal(estimates.diagonal(dim1=1, dim2=2), theta)
    error = estimates[:, [0, 1], [1, 0]] - theta.flip(-1)
    assert torch.equal(error.abs(), torch.ones_like(error))
    assert bool((error[::2] == torch.tensor([-1.0, 1.0])).all()), "at the end of the type box there is one direction"
    assert 0.35 < float((error[1::2] > 0).double().mean()) < 0.65
    assert bool(game.type_box.contains(estimates).all())


def test_every_player_acts_on_its_own_estimate() -> None:
    """A policy that plays the types it is told shows what each player believes; nothing else changes."""
    game = Walkers().double()
    x0, _ = starts(game, 50)
    theta = torch.tensor([1.0, 2.0], dtype=torch.float64).expand(50, 2)

    def telling(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        return theta.unsqueeze(-2).expand(-1, 2, -1)

    played = rollout(game, telling, x0, theta, 0.1, disturbance=Disturbance(belief=0.125))
    told = played.u
    assert torch.equal(told, told[:, :1].expand_as(told)), "an episode has one belief"
    assert bool((told[..., 0, 0] == 1).all())
    assert bool((told[..., 1, 1] == 2).all())
    assert set(told[..., 0, 1].flatten().tolist()) == {1.5, 2.5}
    assert set(told[..., 1, 0].flatten().tolist()) == {0.5, 1.5}


def test_safety_is_judged_by_the_true_types() -> None:
    game = Walkers().double()
    x0 = torch.tensor([[[0.0, 0.3], [0.0, 0.3]]], dtype=torch.float64)
    theta = torch.full((1, 2), 1.0, dtype=torch.float64)

    def straight(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        return torch.tensor([4.0, 0.0], dtype=x.dtype).expand(len(x), 2, 2)

    played = rollout(game, straight, x0, theta, disturbance=Disturbance(belief=0.75))
    assert played.clearance.item() == pytest.approx(0.6 - 0.4, abs=1e-3)
    assert not math.isclose(played.clearance.item(), 0.6 - 0.2 - 0.1 * 5)


def test_disturbances_do_not_change_each_others_numbers() -> None:
    game = make("narrow_road").double()
    x0, theta = starts(game, 4)
    alone = state_push(game, x0, theta, 5, Disturbance(drift=0.1))
    both = state_push(game, x0, theta, 5, Disturbance(drift=0.1, gusts=0.2))
    gusts = state_push(game, x0, theta, 5, Disturbance(gusts=0.2))
    assert alone is not None
    assert both is not None
    assert gusts is not None
    torch.testing.assert_close(both, alone + gusts)
