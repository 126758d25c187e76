"""A policy beside the receding-horizon controller, from the same starts: safety, cost and latency."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import torch
from torch import Tensor

from hno.control.receding_horizon import RecedingHorizon
from hno.control.rollout import Disturbance, Player, rollout
from hno.evaluation.closed_loop import classify, collided, excess_costs, median
from hno.evaluation.metrics import clopper_pearson
from hno.games import Game
from hno.types import Extremal, Trajectory, join, part


class Driven(NamedTuple):
    """What came of some episodes; numbers that do not exist are None."""

    starts: int
    """Safe starts that were driven."""
    collisions: int
    """Collisions among them, between steps too."""
    rate: float | None
    """Collisions per start."""
    interval: tuple[float, float] | None
    """Clopper-Pearson 95 % interval of the rate."""
    median_excess_cost: float | None
    """Median of the joint cost above the label's."""
    largest_excess_cost: float | None
    """Largest of these."""


class Solves(NamedTuple):
    """How often the rest of the game was solved, and how."""

    solves: int
    """In all."""
    searches: int
    """Those in which the last plan was no good start, so that several were searched."""
    failures: int
    """Those without a solution: the last plan was followed."""


class Beside(NamedTuple):
    """Both controllers on the same starts."""

    theta: tuple[float, ...] | None
    """Player types; None for all of them together."""
    policy: Driven
    """The policy."""
    solver: Driven
    """The receding-horizon controller."""
    solves: Solves
    """Its solves."""


class Latency(NamedTuple):
    """Time from a state to controls of one game, on one thread; numbers that do not exist are None."""

    episodes: int
    """Episodes that were played, one at a time."""
    answers: int
    """Answers that were timed, without the first ones."""
    first: float | None
    """Median of the first answers, s."""
    median: float | None
    """Median of the others, s."""
    slow: float | None
    """95 % quantile of the others, s."""
    processor: float | None
    """Median processor time of the others, s: well below `median` on a machine that is busy with other work."""

    @property
    def rate(self) -> float | None:
        """Answers per second, from the median, Hz."""
        return 1 / self.median if self.median else None


def safe_starts(labels: Sequence[Extremal], count: int, clearance: float) -> list[Extremal]:
    """The first safe starts of every label set; fewer where there are no more."""
    return [part(found, classify(found, clearance)[0].nonzero().squeeze(-1)[:count]) for found in labels]


def compare(
    game: Game,
    policy: Player,
    labels: Sequence[Extremal],
    types: Sequence[Sequence[float]],
    interval: int = 1,
    dt: float = 0.02,
    disturbance: Disturbance = Disturbance(),
) -> list[Beside]:
    """Play every start of the labels twice.

    Args:
        game: the game.
        policy: feedback controls of all players.
        labels: one set per type, at least one row in all.
        types: player types of each set.
        interval: control steps between the solves of the receding-horizon controller.
        dt: time for which a control is held, s.
        disturbance: of the controls, the same for both.

    Returns:
        One line per type, and a last one for all of them.
    """
    starts, theta = _starts(labels)
    label = join(labels)
    solver = RecedingHorizon(game, interval)
    played, solved = (rollout(game, p, starts, theta, dt, disturbance=disturbance) for p in (policy, solver))
    rows = torch.arange(len(starts)).split([len(found.status) for found in labels])
    names: list[tuple[float, ...] | None] = [*(tuple(map(float, t)) for t in types), None]
    return [
        Beside(t, driven(played, label, index), driven(solved, label, index), _solves(solver, index))
        for t, index in zip(names, [*rows, torch.arange(len(starts))], strict=True)
    ]


def _starts(labels: Sequence[Extremal]) -> tuple[Tensor, Tensor]:
    return (torch.cat([found.x[:, 0] for found in labels]).float(), torch.cat([f.theta for f in labels]).float())


def driven(played: Trajectory, label: Extremal, rows: Tensor) -> Driven:
    """Some of the episodes in numbers, compared with the labels from the same starts."""
    collisions = int(collided(played)[rows].sum())
    excess = excess_costs(label, played).sum(-1)[rows]
    some = len(rows) > 0
    return Driven(
        starts=len(rows),
        collisions=collisions,
        rate=collisions / len(rows) if some else None,
        interval=clopper_pearson(collisions, len(rows)),
        median_excess_cost=median(excess),
        largest_excess_cost=float(excess.max()) if some else None,
    )


def _solves(solver: RecedingHorizon, rows: Tensor) -> Solves:
    return Solves(*(int(count[rows].sum()) for count in (solver.solves, solver.searches, solver.failures)))


def latency(
    game: Game,
    make_policy: Callable[[], Player],
    labels: Sequence[Extremal],
    every: int = 1,
    dt: float = 0.02,
    episodes: int = 5,
) -> Latency:
    """Time a policy on some episodes, one after the other and without disturbance, on one thread.

    Args:
        game: the game.
        make_policy: the policy for one episode.
        labels: where the starts come from, at least one row in all.
        every: answers of which one counts, beginning with the first: the interval of a receding-horizon controller.
        dt: time for which a control is held, s.
        episodes: how many starts are played, spread over all label sets.
    """
    starts, theta = _starts(labels)
    chosen = torch.linspace(0, len(starts) - 1, min(episodes, len(starts))).round().long()
    first, later, processor = list[float](), list[float](), list[float]()
    with one_thread():
        for row in chosen:
            timed = _Timed(make_policy())
            rollout(game, timed, starts[row : row + 1], theta[row : row + 1], dt)
            first.append(timed.seconds[0])
            later += timed.seconds[every::every]
            processor += timed.processor[every::every]
    numbers = (_quantile(part, share) for part, share in ((first, 0.5), (later, 0.5), (later, 0.95), (processor, 0.5)))
    return Latency(len(chosen), len(later), *numbers)


def _quantile(seconds: Sequence[float], share: float) -> float | None:
    return float(torch.tensor(seconds).quantile(share)) if seconds else None


class _Timed:
    """A policy that notes how long its answers take, on the clock and on the processor."""

    def __init__(self, policy: Player) -> None:
        self.policy, self.seconds, self.processor = policy, list[float](), list[float]()

    def __call__(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        began, worked = time.perf_counter(), time.process_time()
        u = self.policy(tau, x, theta)
        self.seconds.append(time.perf_counter() - began)
        self.processor.append(time.process_time() - worked)
        return u


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use one thread for a while."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
