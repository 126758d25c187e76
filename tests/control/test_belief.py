"""Beliefs over types: what is learned, what is forgotten, and what is played."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hno_examples.memory import Believing as PublicBelief
from hno_examples.three_walkers import ThreeWalkers
from torch import Tensor

import hno
from hno.control import Feedback
from hno.control.belief import Believing, FixedBelief, Learning
from hno.control.disturbance import Disturbance
from hno.control.policy import as_policy
from hno.games import Game, make
from hno.operators import Choice, make_operator
from hno.runtime.belief import distribution
from hno.types import Trajectory
from tests.fakes import small_architecture
from tests.lq import LinearQuadratic
from tests.walkers import Walkers

GAME = Walkers()
SHARP = Learning(noise=0.005, floor=0.0)


def revealing(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
    """Controls that depend on the own type, the others' types, time and state, inside the control box of walkers."""
    others = theta.sum(-1, keepdim=True) - theta
    first = 0.5 * theta - 0.2 * others + 0.3 * tau.unsqueeze(-1)
    return torch.stack([first, 0.1 * x[..., 1] - 0.3 * theta.square() / 4], -1)


def starts(game: Game, count: int, seed: int = 0) -> Tensor:
    return game.initial_box.sample(count, torch.Generator().manual_seed(seed))


def on_grid(policy: Believing, count: int, seed: int = 1) -> tuple[Tensor, Tensor]:
    """True types among the candidates, and their places, (B, P)."""
    players, candidates = policy.grid.shape
    place = torch.randint(candidates, (count, players), generator=torch.Generator().manual_seed(seed))
    return policy.grid[torch.arange(players), place], place


class Recorded(hno.control.Policy):
    """A policy beside the beliefs before every step."""

    def __init__(self, policy: Believing, plays: Callable[..., Tensor] | None = None) -> None:
        self.policy, self.plays, self.past = policy, plays, list[Tensor]()

    def reset(self, x0: Tensor, theta: Tensor) -> None:
        self.policy.reset(x0, theta)
        self.past = [self.policy.belief]

    def act(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        own = self.policy.act(tau, x, theta)
        return own if self.plays is None else self.plays(tau, x, theta)

    def observe(self, x: Tensor, u: Tensor, dt: float) -> None:
        self.policy.observe(x, u, dt)
        self.past.append(self.policy.belief)


def play(game: Game, policy: object, theta: Tensor, dt: float = 0.05, seed: int = 0) -> Trajectory:
    return hno.rollout(game, policy, starts(game, len(theta), seed), theta, dt=dt)


def truth(beliefs: list[Tensor], place: Tensor) -> Tensor:
    """The probability of the other's true type for two players, (K, B, 2)."""
    return torch.stack([belief.take_along_dim(place.flip(-1).unsqueeze(-1), -1).squeeze(-1) for belief in beliefs])


@pytest.mark.parametrize("acts", ["mean", "mode"])
def test_the_true_type_is_found_where_others_know_all(acts: str) -> None:
    """Those who are watched play what their true types predict: nothing speaks against these."""
    policy = Believing(revealing, 7, acts, SHARP, game=GAME)
    theta, place = on_grid(policy, 40)
    recorded = Recorded(policy, revealing)
    play(GAME, recorded, theta)
    right = truth(recorded.past, place)
    torch.testing.assert_close(right[0], torch.full_like(right[0], 1 / 7))
    assert (right.diff(dim=0) >= -1e-12).all()
    assert right[-1].min() > 0.99


@pytest.mark.parametrize("acts", ["mean", "mode"])
def test_the_true_type_is_found_where_both_learn_from_a_common_belief(acts: str) -> None:
    policy = Believing(revealing, 7, acts, SHARP, common=True, game=GAME)
    theta, place = on_grid(policy, 40)
    recorded = Recorded(policy)
    play(GAME, recorded, theta)
    right = truth(recorded.past, place)
    assert (right.diff(dim=0) >= -1e-12).all()
    assert right[-1].min() > 0.99


def test_to_assume_that_the_other_knows_me_misleads_while_it_learns() -> None:
    """What makes the assumption wrong is seen: at the same noise the truth loses weight in some steps."""

    def coupled(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        return (0.5 * theta - theta.flip(-1)).unsqueeze(-1).expand_as(x)

    policy = Believing(coupled, 7, "mean", SHARP, game=GAME)
    theta, place = on_grid(policy, 40)
    recorded = Recorded(policy)
    play(GAME, recorded, theta)
    assert (truth(recorded.past, place).diff(dim=0) < -1e-3).any()


@pytest.mark.parametrize("memory", [math.inf, 0.7])
def test_bayes_rule(memory: float) -> None:
    """Against the normal density of each step, multiplied up one candidate at a time."""
    learning = Learning(0.05, memory, 0.04)
    policy = Believing(revealing, [0.0, 1.0, 2.5, 4.0], "mean", learning, [0.1, 0.2, 0.3, 0.4], game=GAME)
    x, theta, dt = starts(GAME, 3), torch.tensor([[1.0, 2.5], [4.0, 0.0], [0.5, 3.3]]), 0.1
    policy.reset(x, theta)
    expected = np.tile([0.1, 0.2, 0.3, 0.4], (3, 2, 1))
    generator = torch.Generator().manual_seed(2)
    for step in range(4):
        tau = torch.full((3,), 1 - step * dt)
        policy.act(tau, x, theta)
        seen = revealing(tau, x, theta) + 0.3 * torch.randn(3, 2, 2, generator=generator)
        policy.observe(x, seen, dt)
        for row in range(3):
            for watcher, watched in ((0, 1), (1, 0)):
                weights = []
                for k, candidate in enumerate([0.0, 1.0, 2.5, 4.0]):
                    types = theta[row].clone()
                    types[watched] = candidate
                    wanted = revealing(tau[:1], x[row : row + 1], types[None])[0, watched]
                    miss = ((seen[row, watched] - wanted) / 12).double().numpy()  # the box is 12 wide
                    deviation = 0.05 / math.sqrt(dt)
                    density = np.prod(np.exp(-0.5 * (miss / deviation) ** 2) / (deviation * math.sqrt(2 * math.pi)))
                    weights.append(expected[row, watcher, k] ** math.exp(-dt / memory) * density)
                raised = np.maximum(np.array(weights) / sum(weights), 0.01)
                expected[row, watcher] = raised / raised.sum()
    np.testing.assert_allclose(policy.belief.numpy(), expected, rtol=1e-4)


def test_it_is_the_example_with_a_common_belief() -> None:
    """The shortest program of this kind, written apart, with the same density over one step."""
    dt, doubt, candidates = 0.05, 0.1, torch.linspace(0, 4, 5)
    theta = GAME.type_box.sample(6, torch.Generator().manual_seed(5))
    learning = Learning(doubt * math.sqrt(dt), floor=0.0)
    own = play(GAME, Believing(revealing, candidates, learning=learning, common=True, game=GAME), theta)
    other = play(GAME, PublicBelief(GAME, as_policy(revealing), candidates, doubt), theta)
    torch.testing.assert_close(own.u, other.u, rtol=1e-4, atol=1e-4)


def steps_to_recover(learning: Learning, wrong: float, gain: float, dt: float) -> int:
    """Updates until the truth has the larger of two shares, where each adds `gain` to its log odds."""
    belief, miss = np.array([wrong, 1 - wrong]), np.array([[math.sqrt(2 * gain / dt) * learning.noise], [0.0]])
    for step in range(1, 1000):
        belief = learning.updated(belief, miss, dt)
        if belief[1] > 0.5:
            return step
    return 1000


def test_a_floor_bounds_the_time_to_recover() -> None:
    """The log odds against the truth are log(K / floor) at most, whatever was believed for how long."""
    gain, dt, floor = 0.25, 0.1, 2e-3
    learning = Learning(floor=floor)
    long = np.array([0.5, 0.5])
    for _ in range(500):
        long = learning.updated(long, np.array([[0.0], [1.0]]), dt)
    bound = math.ceil(math.log(2 / floor) / gain)
    assert steps_to_recover(learning, long[0], gain, dt) in (bound, bound + 1)
    assert steps_to_recover(learning._replace(floor=0.0), 1 - 1e-15, gain, dt) > 2 * bound


@pytest.mark.parametrize("count", [2, 9, 625])
def test_however_many_candidates_there_are_the_truth_is_believed(count: int) -> None:
    miss = np.ones((count, 1))
    miss[0] = 0
    belief = np.full(count, 1 / count)
    for _ in range(100):
        belief = Learning().updated(belief, miss, 0.1)
    assert belief[0] > 0.99
    np.testing.assert_allclose(belief[1:], Learning().floor / count, rtol=0.01)


def test_forgetting_bounds_the_time_to_recover() -> None:
    """The log odds obey l <- keep l + gain: they turn where keep^n l0 + gain (1 - keep^n) / (1 - keep) does."""
    gain, dt, memory, wrong = 0.25, 0.1, 1.0, 1 - 1e-12
    keep, first = math.exp(-dt / memory), math.log((1 - wrong) / wrong)
    limit = gain / (1 - keep)
    steps = math.ceil(math.log(limit / (limit - first)) / math.log(keep))
    assert steps_to_recover(Learning(memory=memory, floor=0.0), wrong, gain, dt) == steps
    assert steps < -first / gain / 2, "without forgetting it takes more than twice as long"


def test_what_is_learned_in_a_second_does_not_depend_on_the_step() -> None:
    learning, belief = Learning(0.05, 0.8, 3e-3), np.array([0.7, 0.2, 0.1])
    miss = np.array([[0.1], [0.03], [0.0]])
    ends = []
    for steps in (50, 2000):
        found = belief
        for _ in range(steps):
            found = learning.updated(found, miss, 1 / steps)
        ends.append(found)
    np.testing.assert_allclose(ends[0], ends[1], rtol=0.02)


def test_where_all_candidates_predict_the_same_nothing_is_learned() -> None:
    """As on a bound of the control box, whatever is seen."""
    policy = Believing(lambda tau, x, theta: revealing(tau, x, 0 * theta), 5, game=GAME)
    x, theta = starts(GAME, 4), torch.full((4, 2), 2.0)
    policy.reset(x, theta)
    policy.act(torch.ones(4), x, theta)
    policy.observe(x, torch.full((4, 2, 2), 5.0), 0.1)
    torch.testing.assert_close(policy.belief, torch.full((4, 2, 5), 0.2, dtype=torch.float64))


@pytest.mark.parametrize("broken", [math.nan, math.inf])
def test_controls_that_are_not_finite_teach_nothing(broken: float) -> None:
    """Of their own episode alone."""
    policy = Believing(revealing, 5, game=GAME)
    x, theta = starts(GAME, 2), torch.tensor([[0.0, 4.0]] * 2)
    policy.reset(x, theta)
    u = policy.act(torch.ones(2), x, theta)
    u[0] = broken
    policy.observe(x, u, 0.1)
    torch.testing.assert_close(policy.belief[0], torch.full((2, 5), 0.2, dtype=torch.float64))
    assert (policy.belief[1] != 0.2).all()


@pytest.mark.parametrize("common", [False, True])
@pytest.mark.parametrize("acts", ["mean", "mode"])
def test_who_is_sure_of_the_truth_plays_as_if_types_were_known(acts: str, common: bool) -> None:
    policy = Believing(revealing, 5, acts, SHARP, common=common, game=GAME)
    theta, place = on_grid(policy, 6)
    policy.prior = torch.nn.functional.one_hot(place.flip(-1), 5)
    assert torch.equal(play(GAME, policy, theta).u, play(GAME, revealing, theta).u)


def feedback(function: str) -> Feedback:
    torch.manual_seed(0)
    parts = dataclasses.replace(small_architecture(), function=Choice(function))
    operator = make_operator(GAME if function == "value" else make("narrow_road"), parts)
    operator.value_scale.fill_(20.0)
    return Feedback(operator.eval().requires_grad_(False))


@pytest.mark.parametrize("function", ["value", "potential"])
def test_the_expectation_of_one_type_is_the_best_response_to_it(function: str) -> None:
    """With all weight on one combination all three variants are the same, and with the truth they are the policy."""
    policy = feedback(function)
    game = policy.game
    found = {}
    for acts in ("mean", "mode", "expectation"):
        believing = Believing(policy, 3, acts, SHARP)
        theta, place = on_grid(believing, 4)
        believing.prior = torch.nn.functional.one_hot((place.flip(-1) + 1) % 3, 3)
        believing.reset(starts(game, 4), theta)
        found[acts] = believing.act(torch.full((4,), 0.7), starts(game, 4), theta)
    torch.testing.assert_close(found["expectation"], found["mode"])
    torch.testing.assert_close(found["expectation"], found["mean"])
    believing.prior = torch.nn.functional.one_hot(place.flip(-1), 3)
    torch.testing.assert_close(
        play(game, believing, theta, 0.1).u, play(game, policy, theta, 0.1).u, rtol=1e-4, atol=1e-4
    )


@pytest.mark.parametrize("common", [False, True])
def test_the_expectation_maximises_the_expected_hamiltonian(common: bool) -> None:
    """Over random controls, with the Hamiltonian of the game at the costates of every candidate."""
    policy = feedback("value")
    weights = torch.tensor([0.5, 0.2, 0.3])
    believing = Believing(policy, 3, "expectation", prior=weights, common=common)
    x, theta, tau = starts(GAME, 1), torch.tensor([[1.0, 3.0]]), torch.tensor([0.8])
    believing.reset(x, theta)
    chosen = believing.act(tau, x, theta)
    for player in range(2):
        others = chosen.repeat(501, 1, 1)
        others[1:, player] = GAME.control_box.sample(500, torch.Generator().manual_seed(player))
        total = torch.zeros(501)
        for weight, candidate in zip(weights, believing.grid[1 - player], strict=True):
            types = theta.clone()
            types[0, 1 - player] = candidate
            total += weight * GAME.hamiltonian(x, policy.costate(tau, x, types), others, types)[:, player]
        assert (total[0] >= total[1:] - 1e-3).all()


@pytest.mark.parametrize("acts", ["mean", "mode"])
@pytest.mark.parametrize("common", [False, True])
def test_players_who_swap_swap_beliefs(acts: str, common: bool) -> None:
    for game, order in ((GAME, [1, 0]), (ThreeWalkers(), [2, 0, 1])):
        theta = game.type_box.sample(3, torch.Generator().manual_seed(7))
        x = starts(game, 3)
        ends, controls = [], []
        for way in (list(range(game.players)), order):
            policy = Believing(revealing, 3, acts, common=common, game=game)
            policy.reset(x[:, way], theta[:, way])
            for step in range(3):
                u = policy.act(torch.full((3,), 1 - 0.1 * step), x[:, way], theta[:, way])
                policy.observe(x[:, way], u, 0.1)
            ends.append(
                {(way[i], way[j]): policy.marginal(i, j) for i in range(len(way)) for j in range(len(way)) if i != j}
            )
            controls.append(u)
        torch.testing.assert_close(controls[0][:, order], controls[1])
        for pair, belief in ends[0].items():
            torch.testing.assert_close(belief, ends[1][pair])


def test_three_players_learn_both_others_together() -> None:
    """The true pair is found, and marginals are those of independent candidates."""
    game = ThreeWalkers()
    policy = Believing(revealing, 4, "mean", SHARP, game=game)
    theta, place = on_grid(policy, 5)
    recorded = Recorded(policy, revealing)
    play(game, recorded, theta)
    assert policy.belief.shape == (5, 3, 16)
    for watcher in range(3):
        for watched in set(range(3)) - {watcher}:
            found = policy.marginal(watcher, watched)
            torch.testing.assert_close(found.sum(-1), torch.ones(5, dtype=torch.float64))
            assert torch.equal(found.argmax(-1), place[:, watched])
    combined = policy.candidates[0]
    assert len(combined.unique(dim=0)) == 16
    assert (combined[:, 0] == 0).all()


def test_one_player_has_nobody_to_learn_about() -> None:
    one = torch.eye(2).unsqueeze(0)
    game = LinearQuadratic(-one, one, torch.ones(1, 2), one, one)
    lean = lambda tau, x, theta: torch.zeros(*x.shape[:2], game.control_dim) + 0.1 * theta.unsqueeze(-1)  # noqa: E731
    theta = game.type_box.sample(3, torch.Generator().manual_seed(0))
    policy = Believing(lean, 4, game=game)
    dt = game.horizon / 10
    assert torch.equal(play(game, policy, theta, dt).u, play(game, lean, theta, dt).u)
    assert torch.equal(policy.belief, torch.ones(3, 1, 1, dtype=torch.float64))


@pytest.mark.parametrize("acts", ["mean", "mode", "expectation"])
def test_episodes_are_played_independently(acts: str) -> None:
    policy = Believing(feedback("value"), 3, acts)
    x, theta = starts(GAME, 3), GAME.type_box.sample(3, torch.Generator().manual_seed(4))
    whole = hno.rollout(GAME, policy, x, theta, dt=0.1)
    beliefs = policy.belief
    for row in range(3):
        alone = hno.rollout(GAME, policy, x[row : row + 1], theta[row : row + 1], dt=0.1)
        torch.testing.assert_close(alone.x[0], whole.x[row], rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(policy.belief[0], beliefs[row], rtol=1e-3, atol=1e-5)


def test_a_belief_that_never_changes_is_a_fixed_one() -> None:
    theta = GAME.type_box.sample(4, torch.Generator().manual_seed(3))
    one = Believing(revealing, [1.5], learning=SHARP, game=GAME)
    estimates = torch.where(torch.eye(2, dtype=torch.bool), theta.unsqueeze(-1), torch.tensor(1.5)).flatten(0, 1)
    torch.testing.assert_close(
        play(GAME, one, theta).u, play(GAME, FixedBelief(as_policy(revealing), estimates), theta).u
    )


def test_a_policy_with_memory_is_told_of_every_row() -> None:
    told = []

    class Watching(hno.control.Policy):
        def reset(self, x0: Tensor, theta: Tensor) -> None:
            told.append((x0.shape, theta.shape))

        def act(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
            told.append((x.shape, theta.shape))
            return revealing(tau, x, theta)

        def observe(self, x: Tensor, u: Tensor, dt: float) -> None:
            told.append((x.shape, u.shape[:2]))

    policy = Believing(Watching(), 4, game=GAME)
    x, theta = starts(GAME, 3), torch.ones(3, 2)
    policy.reset(x, theta)
    policy.observe(x, policy.act(torch.ones(3), x, theta), 0.1)
    assert told == [(torch.Size([3 * 2 * 5, 2, 2]), torch.Size([3 * 2 * 5, 2]))] * 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"acts": "median"}, "acts must be one of mean, mode, expectation"),
        ({"acts": "expectation"}, "needs costates"),
        ({"types": 1}, "at least 2"),
        ({"types": [[1.0, 2.0]] * 3}, r"\(2, C\)"),
        ({"types": [1.0, math.nan]}, "must be finite"),
        ({"types": []}, "must be finite candidates"),
        ({"learning": Learning(noise=0)}, "noise must be a positive"),
        ({"learning": Learning(memory=-1)}, "memory must be a positive"),
        ({"learning": Learning(floor=1.0)}, "to below 1"),
        ({"learning": Learning(floor=math.nan)}, "to below 1"),
        ({"game": None}, "give `game`"),
    ],
)
def test_options_that_make_no_sense(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Believing(revealing, **{"game": GAME, **options})


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        ([1.0, 2.0], r"shape \(1, 2, 3\)"),
        ([0.0, 0.0, 0.0], "above 0"),
        ([1.0, -1.0, 1.0], "at least 0"),
        ([1.0, math.nan, 1.0], "at least 0"),
    ],
)
def test_priors_that_make_no_sense(prior: list[float], message: str) -> None:
    policy = Believing(revealing, 3, prior=prior, game=GAME)
    with pytest.raises(ValueError, match=message):
        policy.reset(starts(GAME, 1), torch.ones(1, 2))


@pytest.mark.parametrize(("observer", "player"), [(0, 0), (2, 0), (0, 2), (-1, 0)])
def test_nobody_has_a_belief_about_itself(observer: int, player: int) -> None:
    policy = Believing(revealing, 3, game=GAME)
    policy.reset(starts(GAME, 1), torch.ones(1, 2))
    with pytest.raises(ValueError, match="no belief about"):
        policy.marginal(observer, player)


def test_weights_are_scaled_to_probabilities() -> None:
    np.testing.assert_allclose(distribution([1, 3], (2, 2)), [[0.25, 0.75]] * 2)


def test_a_rollout_of_players_who_learn_is_one_of_common_beliefs() -> None:
    theta = GAME.type_box.sample(4, torch.Generator().manual_seed(3))
    x = starts(GAME, 4)
    learned = hno.rollout(GAME, revealing, x, theta, dt=0.1, disturbance=Disturbance(learns="mode"))
    policy = Believing(revealing, acts="mode", common=True, game=GAME)
    assert torch.equal(learned.u, hno.rollout(GAME, policy, x, theta, dt=0.1).u)
    assert not torch.equal(learned.u, hno.rollout(GAME, revealing, x, theta, dt=0.1).u)


def test_who_learns_is_not_wrong_throughout() -> None:
    with pytest.raises(ValueError, match="choose one"):
        play_disturbed(Disturbance(learns="mean", belief=0.5))


def play_disturbed(disturbance: Disturbance) -> Trajectory:
    return hno.rollout(GAME, revealing, starts(GAME, 1), torch.ones(1, 2), dt=0.1, disturbance=disturbance)
