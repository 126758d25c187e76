"""A learned policy beside the controller that solves the rest of the game online: safety, cost and latency."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from hno.control.policy import Policy, as_policy
from hno.control.receding_horizon import RecedingHorizon
from hno.control.rollout import Player, rollout
from hno.data.certificates import safe
from hno.evaluation import format as text
from hno.evaluation.closed_loop import play
from hno.evaluation.outcome import Outcome, numbers_of, outcomes
from hno.evaluation.sections import COUNTS, Column, Evaluation, ModelSection, sections
from hno.games import Game
from hno.types import Extremal, part

log = logging.getLogger(__name__)

CONTROLLERS = {"policy": "learned", "solver": "solved online"}
"""Names of the two controllers in results.json and in tables."""
SOLVES = ("solves", "searches", "failures")
"""How often the rest of the game was solved; how often several plans were searched, because the last one was no good
start; and how often there was no solution, so that the last plan was followed."""


def safe_starts(labels: Sequence[Extremal], count: int, clearance: float) -> list[Extremal]:
    """The first safe starts of every label set; fewer where there are no more."""
    return [part(found, safe(found, clearance).nonzero().squeeze(-1)[:count]) for found in labels]


def compare(evaluation: Evaluation, labels: Sequence[Extremal], interval: int = 1) -> list[dict[str, Any]]:
    """Play every start of the labels with both controllers.

    Args:
        evaluation: the policy, and how it is played.
        labels: one set per type, at least one row in all.
        interval: control steps between the solves of the receding-horizon controller.

    Returns:
        One line per type and a last one, of theta None, for all of them: the `Outcome` of each of `CONTROLLERS`, and
        the counts of `SOLVES`.
    """
    game, dt, disturbance = evaluation.game, evaluation.dt, evaluation.condition.disturbance
    solver, found = RecedingHorizon(game, interval), dict[str, list[Outcome]]()
    for name, controller in (("policy", evaluation.policy), ("solver", solver)):
        played = play(game, controller, labels, dt, disturbance, at_once=math.inf)  # for its counts
        by_type, whole = outcomes([numbers_of(game, *one) for one in played], evaluation.clearance)
        found[name] = [*by_type, whole]
    rows = torch.arange(len(solver.solves))
    sets = [*rows.split([len(one.status) for one in labels]), rows]
    return [
        {
            "theta": None if theta is None else tuple(map(float, theta)),
            **{name: results[place]._asdict() for name, results in found.items()},
            "solves": {name: int(getattr(solver, name)[sets[place]].sum()) for name in SOLVES},
        }
        for place, theta in enumerate([*evaluation.types, None])
    ]


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


@sections.register("online")
class Online(ModelSection):
    """The learned policy beside the controller that solves the rest of the game, from the first safe starts."""

    heading = "Learned policy beside the game solved online"
    note = "excess cost: above the equilibrium's joint cost, median; solves: in all / searched anew / failed"
    columns = (
        Column("theta", "theta", format=text.types),
        Column("controller", "controller"),
        COUNTS[0]._replace(heading="starts"),
        *COUNTS[1:],
        Column("median_excess_cost", "excess cost", format=text.number),
        Column("solves", "solves", format=lambda solves: " / ".join(map(str, solves.values()))),
    )

    def compute(self, evaluation: Evaluation) -> dict[str, Any]:
        """Both controllers on the first `online` safe starts of every type, and the latency of both."""
        game, dt = evaluation.game, evaluation.dt
        count, every = evaluation.options["online"], evaluation.options["online_interval"]
        content = {"starts_per_type": count, "interval": every, "dt": dt, "table": [], "latency": None}
        chosen = safe_starts(evaluation.labels, count, evaluation.clearance)
        total = sum(len(found.status) for found in chosen)
        if total == 0:
            return content | {"reason": "no start has a safe equilibrium"}
        log.info("Playing %d starts by solving the rest of the game every %g s.", total, every * dt)
        table = compare(evaluation, chosen, every)
        learned = latency(game, lambda: evaluation.policy, chosen, dt=dt)
        online = latency(game, lambda: RecedingHorizon(game, every), chosen, every, dt)
        spent = {"policy": learned._asdict(), "solver": online._asdict()}
        return content | {"table": table, "latency": spent, "reason": None}

    def rows(self, content: Mapping[str, Any]) -> list[dict[str, Any]]:
        """Two lines per type, one of each controller."""
        return [
            {
                **row[controller],
                "theta": row["theta"],
                "collisions": row[controller]["collisions"] if row[controller]["safe_starts"] else None,
                "controller": name,
                "solves": row["solves"] if controller == "solver" else {},
            }
            for row in content["table"]
            for controller, name in CONTROLLERS.items()
        ]

    def remarks(self, content: Mapping[str, Any], results: Mapping[str, Any]) -> list[str]:
        """How often the game was solved, and how long each controller takes; or why there is nothing."""
        if content["latency"] is None:
            return [f"Solved online: n/a ({content['reason']})."]
        every = f"The rest of the game was solved every {1000 * content['interval'] * content['dt']:g} ms."
        return [every, *(f"{CONTROLLERS[name]}: {_spent(spent)}." for name, spent in content["latency"].items())]


def _spent(spent: Mapping[str, Any]) -> str:
    played = f"one game on one thread, {spent['answers']} answers in {text.counted(spent['episodes'], 'episode')}"
    first = f"the first answer takes {_milliseconds(spent['first'])}"
    if spent["median"] is None:
        return f"{first}, and there is no other; {played}"
    middle, slow, busy = (_milliseconds(spent[name]) for name in ("median", "quantile_95", "processor_time"))
    return f"{spent['rate']:.1f} Hz, {middle} an answer (95 %: {slow}; processor time {busy}); {first}; {played}"


def _milliseconds(seconds: float) -> str:
    return f"{text.significant(1000 * seconds)} ms"
