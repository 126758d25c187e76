from __future__ import annotations

import functools
from typing import Any

import pytest
import torch
from scipy.stats import binom, kstest
from torch import Tensor

from hno.data.labels import Request, start_states
from hno.evaluation import certificate
from hno.evaluation.certificate import (
    LEVELS,
    SPLIT,
    Certificate,
    Plan,
    Trials,
    certify,
    conditional_bound,
    draw,
    play,
    ranking,
    region,
)
from hno.evaluation.metrics import upper_bound
from hno.games import Box, ControlAffineGame
from hno.types import Extremal, Field, Points, Status
from tests.fakes import Controller, fake_labels

REPEATS, BETA = 200, 0.1
EDGE = 0.8
"""Starts beyond it hit the wall: a share of 0.2."""


class Wall(ControlAffineGame):
    """One player who drifts along the first state towards a wall, which starts beyond `EDGE` reach in time."""

    horizon = label_step = 1.0

    def __init__(self) -> None:
        super().__init__()
        self.roles = (0,)
        self.state_box = Box([[-1, -1, -1]], [[3, 2, 2]])
        self.initial_box = Box([[0, 0, 0]], [[1, 1, 1]])
        self.control_box, self.type_box = Box([-1], [1]), Box([0], [1])
        self.register_buffer("input_matrix", torch.tensor([[1.0], [0.0], [0.0]]))
        self.register_buffer("effort_weight", torch.ones(1))

    def drift(self, x: Tensor) -> Tensor:
        return torch.tensor([1.0, 0.0, 0.0]).to(x).expand_as(x)

    def positions(self, x: Tensor) -> Tensor:
        return x[..., :2]

    def terminal_value(self, x: Tensor) -> Tensor:
        return -x[..., 0].square()

    def constraint(self, x: Tensor, theta: Tensor) -> Tensor:
        return x[..., :1] - 1 - EDGE

    def sensors(self, theta: Tensor) -> Tensor:
        return theta.unsqueeze(-1)


def idle(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
    return torch.zeros(len(x), 1, 1)


def is_safe(x: Tensor) -> Tensor:
    """Starts whose equilibrium is safe, by decree; it depends on whether they hit the wall."""
    return x[..., 1] < 0.9 - 0.5 * x[..., 0]


def is_lost(x: Tensor) -> Tensor:
    """Starts whose equilibrium is not found."""
    return x[..., 2] < 0.8 * x[..., 0]


def solve(x0: Tensor, theta: Tensor) -> Extremal:
    """A solver that answers at once."""
    status = [Status.STALLED if lost else Status.CONVERGED for lost in is_lost(x0[:, 0])]
    clearance = [0.5 if safe else -0.5 for safe in is_safe(x0[:, 0])]
    return fake_labels(Wall(), [0.5], len(x0), status=status, clearance=clearance)


@functools.cache
def played(tests: int, seed: int, split: str, noise: float, chance: bool) -> Trials:
    """Episodes are the same for every bound."""
    return play(controller(chance), Plan(tests, BETA, seed, dt=1.0, noise=noise), split)


def controller(chance: bool = False) -> Any:
    """A controller whose values know roughly where the wall is, or nothing of it."""

    def promised(points: Points) -> Field:
        x, y, z = points.x.unbind(-1)
        value = -z if chance else -(x + y / 2)
        return Field(value, value, points.x.unsqueeze(-3))

    return Controller(Wall(), idle, promised)


def certified(seed: int = 0, *, chance: bool = False, **plan: Any) -> Certificate:
    """A certificate of the controller."""

    def remembered(policy: object, plan: Plan, split: str) -> Trials:
        return played(plan.tests, plan.seed, split, plan.noise, chance)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(certificate, "play", remembered)
        patch.setattr(certificate, "MARGINS", {"value": certificate.MARGINS["value"]})
        return certify(controller(chance), Plan(**{"tests": 120, "beta": BETA, "dt": 1.0, "seed": seed, **plan}), solve)


SIDE = torch.linspace(0, 1, 121)[:-1] + 1 / 240
GRID = torch.cartesian_prod(SIDE, SIDE, SIDE)
"""All starts."""


def share(hit: Tensor, of: Tensor) -> float:
    """Probability of a hit given a member."""
    return float((hit & of).sum() / of.sum())


HITS, SAFE, LOST = GRID[:, 0] >= EDGE, is_safe(GRID), is_lost(GRID)
FOUND = share(HITS, SAFE & ~LOST)
TRUE = share(HITS, SAFE)


def wrong(found: list[float], true: float) -> int:
    """How many bounds do not hold."""
    return sum(bound < true for bound in found)


def most(chance: float) -> int:
    """What a count of `REPEATS` exceeds with a probability of 1e-4."""
    return int(binom.isf(1e-4, REPEATS, chance))


def test_bound_over_all_starts_is_wrong_exactly_as_often_as_the_binomial_says() -> None:
    counts = torch.arange(121)
    missed = [upper_bound(int(k), 120, BETA) < 1 - EDGE for k in counts]
    chance = float(binom.pmf(counts.numpy(), 120, 1 - EDGE)[missed].sum())
    assert 0.05 < chance <= BETA
    count = wrong([certified(seed, equilibria=0).every.bound for seed in range(REPEATS)], 1 - EDGE)
    assert binom.isf(1 - 1e-4, REPEATS, chance) <= count <= most(chance)


@pytest.mark.parametrize("equilibria", [None, 25])
def test_bounds_over_safe_starts_hold_as_often_as_they_say(equilibria: int | None) -> None:
    made = [certified(seed, equilibria=equilibria).safe for seed in range(REPEATS)]
    known = [found for found in made if found is not None]
    assert len(known) == REPEATS
    assert wrong([found.bound for found in known], FOUND) <= most(BETA)
    assert wrong([found.worst_bound for found in known], TRUE) <= most(BETA)
    assert all(found.worst_bound >= found.bound for found in known)
    assert any(found.unsolved and found.unsolved_collisions for found in known)


def test_starts_without_an_equilibrium_are_not_dropped() -> None:
    """The first of the two bounds says nothing about these, and would be wrong about all safe starts."""
    assert TRUE > 1.2 * FOUND
    found = [certified(seed, tests=3000, equilibria=None).safe for seed in range(3)]
    assert all(one is not None and one.bound < TRUE < one.worst_bound for one in found)


def test_region_collides_more_than_promised_as_rarely_as_it_says() -> None:
    target, margin = 0.1, -(GRID[:, 0] + GRID[:, 1] / 2)
    kept, shares = 0, list[float]()
    for seed in range(REPEATS):
        region = certified(seed, target=target, equilibria=0).region
        if region is not None:
            kept += share(HITS, margin >= (-torch.inf if region.level is None else region.level)) > target
            shares.append(region.share)
    assert kept <= most(BETA)
    assert len(shares) > 0.8 * REPEATS
    assert sorted(shares)[len(shares) // 2] > 0.6


def test_a_margin_that_knows_nothing_finds_a_region_as_rarely_as_it_may() -> None:
    """No set of starts with a level of it collides less often than all do."""
    found = [certified(seed, target=0.99 * (1 - EDGE), equilibria=0, chance=True).region for seed in range(REPEATS)]
    assert sum(region is not None for region in found) <= most(BETA)


def test_the_margin_that_promises_most_is_taken() -> None:
    """Of this game, the distance to the wall knows everything and the values know some of it."""
    region = certify(controller(), Plan(tests=400, beta=BETA, dt=1.0, target=0.05, equilibria=0), solve).region
    assert region is not None
    assert region.margin == "distance"
    assert EDGE - 0.1 < region.share < EDGE / (1 - 0.05) + 0.1


def test_a_region_of_all_starts_has_no_level() -> None:
    region = certified(target=0.5, equilibria=0).region
    assert region is not None
    assert (region.level, region.share, region.tests) == (None, 1.0, 120)


def test_bounds_grow_with_collisions_and_shrink_with_tests() -> None:
    over = [upper_bound(k, 50, 0.01) for k in range(51)]
    assert over == sorted(over)
    assert over[-1] == 1
    assert upper_bound(2, 100, 0.01) < upper_bound(2, 50, 0.01) < upper_bound(2, 50, 0.001)
    assert certified(equilibria=0).every.bound == upper_bound(certified(equilibria=0).every.collisions, 120, BETA)


def test_few_tests_that_say_who_is_a_member_are_not_taken_for_all() -> None:
    """A fifth are members, and half of these are hits; of 20 tests the share of members is known badly."""
    generator, wrong = torch.Generator().manual_seed(0), 0
    for _ in range(REPEATS):
        members = torch.rand(2000, generator=generator) < 0.2
        hits = members & (torch.rand(2000, generator=generator) < 0.5)
        wrong += conditional_bound(hits, members, 20, BETA) < 0.5
    assert wrong <= binom.ppf(0.999, REPEATS, BETA)


def test_no_region_is_tried_after_one_that_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is told apart best collides there, and the larger regions that hold it would pass."""
    count, plan = 2000, Plan(2000, BETA, target=0.05)
    margin, none = torch.arange(count, 0, -1).float(), torch.zeros(count, dtype=torch.bool)
    hits = none.clone()
    monkeypatch.setattr(certificate, "margins", lambda *given: {"value": margin})
    chosen, fine = (Trials(torch.zeros(count, 1, 3), torch.zeros(count, 1), none) for _ in range(2))
    found = region(controller(), chosen, fine, plan)
    assert found is not None
    assert (found.level, found.tests) == (None, count)
    hits[:40] = True
    assert upper_bound(40, count, BETA) < plan.target
    assert region(controller(), chosen, fine._replace(collided=hits), plan) is None


def test_without_members_nothing_is_known() -> None:
    none = torch.zeros(20, dtype=torch.bool)
    assert conditional_bound(none, none, 20, BETA) == conditional_bound(none, none, 5, BETA) == 1


def test_equilibria_of_all_tests_bound_better_than_those_of_some() -> None:
    some, every = (certified(3, tests=600, equilibria=count).safe for count in (50, None))
    assert some is not None
    assert every is not None
    assert some.collisions == every.collisions
    assert FOUND < every.bound < some.bound
    assert (some.solved, every.solved) == (50, 600)


def test_only_collisions_and_the_first_tests_are_solved() -> None:
    asked = list[int]()

    def counting(x0: Tensor, theta: Tensor) -> Extremal:
        asked.append(len(x0))
        return solve(x0, theta)

    policy = controller()
    found = certify(policy, Plan(tests=100, beta=BETA, dt=1.0, equilibria=10, seed=1), counting)
    assert found.every.collisions <= asked[0] <= found.every.collisions + 10
    certify(policy, Plan(tests=100, beta=BETA, dt=1.0, equilibria=0, seed=1), counting)
    assert len(asked) == 1


def test_starts_and_types_are_uniform_and_more_begin_with_the_fewer() -> None:
    game = Wall()
    x0, theta = draw(game, 4000, 5, SPLIT)
    columns = torch.cat([x0.flatten(1), theta], 1)
    assert all(kstest(column.numpy(), "uniform").pvalue > 1e-4 for column in columns.T)
    assert float(columns.T.corrcoef().triu(1).abs().max()) < 0.08
    assert torch.equal(draw(game, 10, 5, SPLIT)[0], x0[:10])
    assert torch.equal(draw(game, 10, 5, SPLIT)[1], theta[:10])


def test_listed_types_are_equally_likely() -> None:
    _, theta = draw(Wall(), 6000, 0, SPLIT, [(0.25,), (0.5,), (1.0,)])
    values, counts = theta.unique(return_counts=True)
    assert values.tolist() == [0.25, 0.5, 1.0]
    assert all(1850 < count < 2150 for count in counts)


def test_tests_share_no_start_with_labels_levels_or_other_seeds() -> None:
    game = Wall()
    tests, _ = draw(game, 200, 0, SPLIT)
    others = [draw(game, 200, 0, LEVELS)[0], draw(game, 200, 1, SPLIT)[0]]
    others += [start_states(game, Request((0.5,), 200, 0, split)).float() for split in ("train", "validation", SPLIT)]
    for other in others:
        assert not torch.isin(tests[..., 0], other[..., 0]).any()


def test_ranking_counts_pairs() -> None:
    collided = torch.tensor([True, True, False, False])
    assert ranking(torch.tensor([0.0, 1.0, 2.0, 3.0]), collided) == 1
    assert ranking(torch.tensor([3.0, 2.0, 1.0, 0.0]), collided) == 0
    assert ranking(torch.tensor([1.0, 2.0, 1.0, 3.0]), collided) == (0.5 + 1 + 0 + 1) / 4
    assert ranking(torch.zeros(4), collided) == 0.5
    assert ranking(torch.zeros(4), torch.zeros(4, dtype=torch.bool)) == 0.5


def test_types_and_noise_are_played_as_asked() -> None:
    calm, noisy = (certified(2, tests=400, equilibria=0, noise=noise).every.collisions for noise in (0.0, 0.4))
    assert calm != noisy
    assert certified(2, tests=400, equilibria=0).every.collisions == calm


@pytest.mark.parametrize(
    ("entry", "value"),
    [("tests", 0), ("tests", 2.5), ("beta", 0.0), ("beta", 1.0), ("beta", float("nan")), ("target", -0.1)],
)
def test_a_plan_that_states_nothing_is_refused(entry: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"^{entry} must be a .*got {value!r}"):
        certified(0, **{entry: value})
