"""A learned policy beside the game solved online: counts, costs and times."""

from __future__ import annotations

import time

import pytest
import torch
from torch import Tensor

from hno.evaluation.online import compare, latency, safe_starts
from hno.pontryagin import solve
from hno.types import Extremal, Status
from tests.fakes import evaluation_of, fake_labels
from tests.walkers import Walkers


def straight(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
    """Walk along x at 4 m/s and into whoever comes."""
    return torch.tensor([4.0, 0.0]).expand(len(x), 2, 2)


def solved(*theta: float, count: int = 2) -> Extremal:
    game = Walkers()
    x0 = game.initial_box.sample(count, torch.Generator().manual_seed(0))
    x0[..., 1] = 0.01  # head-on
    return solve(game, x0, torch.tensor([theta]).expand(count, -1))


def test_only_the_first_safe_starts_are_played() -> None:
    clearance = [0.5, -1.0, 0.01, 0.02, 0.5, 0.5]
    status = [Status.CONVERGED] * 4 + [Status.STALLED, Status.CONVERGED]
    found = fake_labels(Walkers(), (1.0, 1.0), 6, 0, status, clearance)
    few, none = safe_starts([found, found._replace(clearance=-found.clearance - 9)], 2, clearance=0.02)
    assert torch.equal(few.x, found.x[[0, 3]])
    assert len(none.status) == 0


def test_both_controllers_play_the_same_starts_and_the_solver_avoids_the_other() -> None:
    types = [(0.0, 0.0), (2.0, 1.0), (4.0, 4.0)]
    labels = [solved(*types[0], count=1), solved(*types[1]), solved(*types[2], count=1)]
    labels[2] = safe_starts(labels[2:], 0, 0.02)[0]
    evaluation = evaluation_of(Walkers(), straight, labels, types=types, dt=0.1, noise=0.01, seed=1)
    rows = compare(evaluation, labels, interval=2)
    assert [row["theta"] for row in rows] == [*types, None]
    learned, online, solves = ([row[name] for row in rows] for name in ("policy", "solver", "solves"))
    assert [row["safe_starts"] for row in learned] == [row["safe_starts"] for row in online] == [1, 2, 0, 3]
    assert [row["collisions"] for row in learned] == [1, 2, 0, 3]
    assert [row["collisions"] for row in online] == [0, 0, 0, 0]
    assert [row["solves"] for row in solves] == [5, 10, 0, 15]
    assert [row["failures"] for row in solves] == [0, 0, 0, 0]
    assert (online[2]["rate"], learned[2]["interval"], online[2]["median_excess_cost"]) == (None, None, None)
    assert learned[3]["rate"] == 1.0
    assert online[3]["interval"] == pytest.approx((0, 1 - 0.025 ** (1 / 3)))
    for place in (0, 1, 3):
        assert online[place]["median_excess_cost"] < learned[place]["median_excess_cost"]


class Slow:
    """A policy that takes its time, longer for the first answer, and every second answer takes none."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        assert torch.get_num_threads() == 1
        assert len(x) == 1
        if self.calls % 2 == 0:
            time.sleep(0.01 if self.calls else 0.05)
        self.calls += 1
        return straight(tau, x, theta)


def test_latency_is_of_one_game_on_one_thread_and_of_answers_that_count() -> None:
    labels = [fake_labels(Walkers(), (1.0, 1.0), 3), fake_labels(Walkers(), (4.0, 1.0), 4)]
    torch.set_num_threads(2)
    try:
        found = latency(Walkers(), Slow, labels, every=2, dt=0.1, episodes=3)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(1)
    assert (found.episodes, found.answers) == (3, 3 * 4)
    assert 0.05 <= found.first < 0.2
    assert 0.01 <= found.median <= found.quantile_95
    assert found.median < 0.04
    assert found.processor_time < 0.008, "sleep takes no processor time"
    assert found.rate == pytest.approx(1 / found.median)
    assert latency(Walkers(), Slow, labels, dt=0.1, episodes=99).episodes == 7
    assert latency(Walkers(), Slow, labels, dt=0.1, episodes=1).answers == 9
    alone = latency(Walkers(), Slow, labels, every=99, dt=0.1, episodes=1)
    assert (alone.answers, alone.median, alone.quantile_95, alone.processor_time, alone.rate) == (
        0,
        None,
        None,
        None,
        None,
    )
