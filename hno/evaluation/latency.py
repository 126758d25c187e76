"""How long a controller takes from a state to controls."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from hno.control.policy import Policy, as_policy
from hno.control.rollout import Player, rollout
from hno.games import Game
from hno.types import Extremal


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
    quantile_95: float | None
    """95 % quantile of the others, s."""
    processor_time: float | None
    """Median processor time of the others, s: well below `median` on a machine that is busy with other work."""
    rate: float | None
    """Answers per second, from the median, Hz."""


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
    starts = torch.cat([found.x[:, 0] for found in labels]).float()
    theta = torch.cat([found.theta for found in labels]).float()
    chosen = torch.linspace(0, len(starts) - 1, min(episodes, len(starts))).round().long()
    first, later, processor = list[float](), list[float](), list[float]()
    for row in chosen:
        timed = _Timed(make_policy())
        rollout(game, timed, starts[row : row + 1], theta[row : row + 1], dt, threads=1)
        first.append(timed.seconds[0])
        later += timed.seconds[every::every]
        processor += timed.processor[every::every]
    middle, slow, busy = _quantile(later, 0.5), _quantile(later, 0.95), _quantile(processor, 0.5)
    return Latency(len(chosen), len(later), _quantile(first, 0.5), middle, slow, busy, 1 / middle if middle else None)


def _quantile(seconds: Sequence[float], share: float) -> float | None:
    return float(torch.tensor(seconds).quantile(share)) if seconds else None


class _Timed(Policy):
    """A policy that records how long its answers take, on the clock and on the processor."""

    def __init__(self, policy: Player) -> None:
        self.policy, self.seconds, self.processor = as_policy(policy), list[float](), list[float]()
        self.reset, self.observe = self.policy.reset, self.policy.observe  # type: ignore[method-assign]

    def act(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        began, worked = time.perf_counter(), time.process_time()
        u = self.policy.act(tau, x, theta)
        self.seconds.append(time.perf_counter() - began)
        self.processor.append(time.process_time() - worked)
        return u
