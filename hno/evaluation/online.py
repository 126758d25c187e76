"""A learned policy beside the controller that solves the rest of the game online: safety, cost and latency."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from hno.control.receding_horizon import RecedingHorizon
from hno.control.rollout import Disturbance, Player
from hno.data.certificates import CLEARANCE, safe
from hno.evaluation import format as text
from hno.evaluation.closed_loop import play
from hno.evaluation.latency import latency
from hno.evaluation.outcome import Outcome, outcome, together
from hno.evaluation.sections import Column, Evaluation, ModelSection, sections
from hno.games import Game
from hno.types import Extremal, Trajectory, join, part

log = logging.getLogger(__name__)


class SolverCounts(NamedTuple):
    """How often the rest of the game was solved, and how."""

    solves: int
    """In all."""
    searches: int
    """Those in which the last plan was no good start, so that several were searched."""
    failures: int
    """Those without a solution: the last plan was followed."""


class OnlineRow(NamedTuple):
    """Both controllers on the same starts."""

    theta: tuple[float, ...] | None
    """Player types; None for all of them together."""
    policy: Outcome
    """Of the learned policy."""
    solver: Outcome
    """Of the receding-horizon controller."""
    solves: SolverCounts
    """Of the receding-horizon controller."""

    def content(self) -> dict[str, Any]:
        """JSON content."""
        return {"theta": self.theta, **{name: getattr(self, name)._asdict() for name in self._fields[1:]}}


def safe_starts(labels: Sequence[Extremal], count: int, clearance: float) -> list[Extremal]:
    """The first safe starts of every label set; fewer where there are no more."""
    return [part(found, safe(found, clearance).nonzero().squeeze(-1)[:count]) for found in labels]


def compare(
    game: Game,
    policy: Player,
    labels: Sequence[Extremal],
    types: Sequence[Sequence[float]],
    interval: int = 1,
    dt: float = 0.02,
    disturbance: Disturbance = Disturbance(),
    clearance: float = CLEARANCE,
) -> list[OnlineRow]:
    """Play every start of the labels with both controllers.

    Args:
        game: the game.
        policy: feedback controls of all players.
        labels: one set per type, at least one row in all.
        types: player types of each set.
        interval: control steps between the solves of the receding-horizon controller.
        dt: time for which a control is held, s.
        disturbance: of the episodes, the same for both.
        clearance: what the label must keep for its start to count, in the unit of the game's constraint.

    Returns:
        One line per type, and a last one for all of them.
    """
    solver = RecedingHorizon(game, interval)
    learned, online = (play(game, controller, labels, dt, disturbance) for controller in (policy, solver))
    rows = torch.arange(len(solver.solves)).split([len(found.status) for found in labels])
    lines = [
        _row(game, tuple(map(float, theta)), found, played, solver, index, clearance)
        for theta, found, *played, index in zip(types, labels, learned, online, rows, strict=True)
    ]
    whole = [together(labels, episodes)[1] for episodes in (learned, online)]
    return [*lines, _row(game, None, join(labels), whole, solver, torch.cat(rows), clearance)]


def _row(
    game: Game,
    theta: tuple[float, ...] | None,
    labels: Extremal,
    played: Sequence[Trajectory],
    solver: RecedingHorizon,
    rows: Tensor,
    clearance: float,
) -> OnlineRow:
    learned, online = (outcome(game, labels, episodes, clearance) for episodes in played)
    counts = (int(count[rows].sum()) for count in (solver.solves, solver.searches, solver.failures))
    return OnlineRow(theta, learned, online, SolverCounts(*counts))


CONTROLLERS = {"policy": "learned", "solver": "solved online"}
"""Names of the two controllers in results.json and in tables."""


@sections.register("online")
class Online(ModelSection):
    """The learned policy beside the controller that solves the rest of the game, from the first safe starts."""

    heading = "Learned policy beside the game solved online"
    note = "excess cost: above the equilibrium's joint cost, median; solves: in all / searched anew / failed"
    columns = (
        Column("theta", "theta", format=text.types),
        Column("controller", "controller"),
        Column("safe_starts", "starts", format=text.whole),
        Column("collisions", "collisions", format=text.whole),
        Column("rate", "rate", format=text.percent),
        Column("interval", "95 % interval", format=text.interval),
        Column("median_excess_cost", "excess cost", format=text.number),
        Column("solves", "solves", format=lambda solves: " / ".join(map(str, solves.values()))),
    )

    def compute(self, evaluation: Evaluation) -> dict[str, Any]:
        """Both controllers on the first `online` safe starts of every type, and the latency of both."""
        options, game, dt = evaluation.options, evaluation.game, evaluation.dt
        count, every = options["online"], options["online_interval"]
        content = {"starts_per_type": count, "interval": every, "dt": dt, "table": [], "latency": None}
        chosen = safe_starts(evaluation.labels, count, evaluation.clearance)
        total = sum(len(found.status) for found in chosen)
        if total == 0:
            return content | {"reason": "no start has a safe equilibrium"}
        log.info("Playing %d starts by solving the rest of the game every %g s.", total, every * dt)
        disturbance, clearance = evaluation.condition.disturbance, evaluation.clearance
        rows = compare(game, evaluation.policy, chosen, evaluation.types, every, dt, disturbance, clearance)
        learned = latency(game, lambda: evaluation.policy, chosen, dt=dt)
        online = latency(game, lambda: RecedingHorizon(game, every), chosen, every, dt)
        return content | {
            "table": [row.content() for row in rows],
            "latency": {"policy": learned.content(), "solver": online.content()},
            "reason": None,
        }

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
