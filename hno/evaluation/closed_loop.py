"""How safe a policy is, type by type, on starts whose equilibrium is safe."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torchmetrics.functional import weighted_mean_absolute_percentage_error

from hno.control import Feedback
from hno.control.rollout import Disturbance, Player, rollout
from hno.data.rows import rows_of
from hno.evaluation import format as text
from hno.evaluation.metrics import in_batches
from hno.evaluation.outcome import Outcome, outcome, pooled
from hno.evaluation.sections import COUNTS, Column, Evaluation, ModelSection, Type, sections
from hno.games import Game
from hno.games.base import own_costate
from hno.types import Extremal, PotentialField, Status, Trajectory

AT_ONCE = 4096
"""Starts that are played together, at most, but for those of one type: an episode takes some 10 kB."""


class TypeRow(NamedTuple):
    """One line of the collision table."""

    theta: Type
    seen: bool
    """Whether the operator was trained with labels of these types."""
    extrapolated: bool
    """Whether the types lie outside the range that the game is made for."""
    outside_seen: bool
    """Whether they lie outside the smallest box around the types that the operator was trained with, if any."""
    outcome: Outcome
    value_error: float | None
    """Weighted absolute percentage error of values at the nodes of converged labels, as a fraction, if any."""
    costate_error: float | None
    """The same of all costates."""

    def content(self) -> dict[str, Any]:
        """All entries with those of the outcome beside them, for results.json."""
        content = self._asdict()
        return content | content.pop("outcome")._asdict()


def play(
    game: Game,
    policy: Player,
    labels: Iterable[Extremal],
    dt: float,
    disturbance: Disturbance = Disturbance(),
    at_once: float = AT_ONCE,
) -> Iterator[tuple[Extremal, Trajectory]]:
    """Sets of labels, each with the episodes from its start states, with controls held for `dt`, s.

    The paths of all need not fit into memory: of sets up to `at_once` starts, which are played together, or of one.
    """
    for some in _gathered(labels, at_once):
        starts = torch.cat([found.x[:, 0] for found in some]).float()
        types = torch.cat([found.theta for found in some]).float()
        yield from _apart(some, rollout(game, policy, starts, types, dt, disturbance=disturbance))


def _apart(labels: Sequence[Extremal], played: Trajectory) -> Iterator[tuple[Extremal, Trajectory]]:
    """Each set with its own episodes of those that were played together."""
    columns = zip(*(column.split([len(found.status) for found in labels]) for column in played[1:]), strict=True)
    yield from ((found, Trajectory(played.t, *paths)) for found, paths in zip(labels, columns, strict=True))


def _gathered(labels: Iterable[Extremal], most: float) -> Iterator[list[Extremal]]:
    """Sets that have at most so many starts together, or one that has more."""
    some, count = list[Extremal](), 0
    for found in labels:
        if some and count + len(found.status) > most:
            yield some
            some, count = [], 0
        some.append(found)
        count += len(found.status)
    if some:
        yield some


def collision_table(evaluation: Evaluation) -> list[TypeRow]:
    """What came of the episodes from the starts of labels, and the errors along these, type by type."""
    box, rows = evaluation.game.type_box, list[TypeRow]()
    known = [tuple(map(float, types)) for types in evaluation.seen]
    for found, played in zip(evaluation.labels, evaluation.played, strict=True):
        theta = tuple(found.theta[0].tolist())
        extrapolated = not bool(box.contains(found.theta[0].to(box.lo)))
        ranges = [(min(column), max(column)) for column in zip(*known, strict=True)]
        outside = any(not low <= own <= high for own, (low, high) in zip(theta, ranges, strict=False))
        came, errors = outcome(played, evaluation.clearance), label_errors(evaluation.policy, found)
        rows.append(TypeRow(theta, theta in known, extrapolated, outside, came, *errors))
    return rows


def label_errors(policy: Feedback, found: Extremal) -> tuple[float | None, float | None]:
    """Weighted absolute percentage errors of values and costates at the nodes of converged labels, as in training.

    Costates of a potential are own ones. The sum of absolute errors over the sum of absolute labels; None where no
    label converged.
    """
    if not bool((found.status == Status.CONVERGED).any()):
        return None, None
    points, labels, _ = rows_of(policy.game, [found])
    assert labels is not None
    predicted = in_batches(policy.operator.field, points)
    if isinstance(predicted, PotentialField):
        own = own_costate(labels.costate).unsqueeze(-3)
        pairs = (predicted.players, labels.value), (predicted.costate, own)
    else:
        pairs = (predicted.value, labels.value), (predicted.costate, labels.costate)
    value, costate = (float(weighted_mean_absolute_percentage_error(*pair)) for pair in pairs)
    return value, costate


@sections.register("table")
class CollisionTable(ModelSection):
    """Collisions, distances, costs and errors by type."""

    heading = "Collisions by type"
    note = (
        "safe: starts whose equilibrium keeps the clearance; distance: smallest, 5 % quantile and median; excess cost: "
        "above the equilibrium's joint cost, median; saturated: controls on a bound; outside: steps outside the PDE "
        "box; errors: of values and costates along labels; apart: unsolved / inevitable / marginal starts"
    )
    columns = (
        Column("theta", "theta", format=text.types),
        Column("labels", "labels"),
        Column("safe", "safe", format=lambda counts: f"{counts[0]:,} of {counts[1]:,}"),
        *COUNTS[1:],
        Column("distances", "distance", "m", text.numbers),
        Column("excess", "excess cost", format=text.cost),
        Column("saturated", "saturated", format=lambda share: text.percent(share, 1)),
        Column("outside", "outside", format=lambda share: text.percent(share, 1)),
        Column("errors", "errors", format=lambda errors: ", ".join(text.percent(error, 1) for error in errors)),
        Column("apart", "apart", format=lambda counts: " / ".join(map(text.whole, counts))),
    )

    def compute(self, evaluation: Evaluation) -> list[dict[str, Any]]:
        """One line per type."""
        return [row.content() for row in collision_table(evaluation)]

    def rows(self, content: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """One line per type, with entries that belong together in one column."""
        return [
            {
                **row,
                "labels": "seen" if row["seen"] else "unseen",
                "safe": (row["safe_starts"], row["starts"]),
                "distances": row["distance_quantiles"] and row["distance_quantiles"][::2],
                "excess": (row["median_excess_cost"], row["median_label_cost"]),
                "outside": row.get("outside"),  # results that are older do not say it
                "errors": (row["value_error"], row["costate_error"]),
                "apart": (row["unsolved"], row["inevitable"], row["marginal"]),
            }
            for row in content
        ]

    def remarks(self, content: Sequence[Mapping[str, Any]], results: Mapping[str, Any]) -> list[str]:
        """The totals, which types have no rate and why, and which lie outside the game's range or that of training."""
        keeps = f"{results['clearance']:g} {results['constraint_unit']}".strip()
        said = [verdict(content)]
        said += [
            f"No rate (n/a) at {text.at(row['theta'])}: of {row['starts']} starts none has an equilibrium that keeps "
            f"{keeps}; {row['unsolved']} unsolved, {row['inevitable']} inevitable, {row['marginal']} marginal."
            for row in content
            if row["rate"] is None
        ]
        said += [
            f"{text.counted(row['lost'], 'episode')} at {text.at(row['theta'])} did not stay finite: a collision each."
            for row in content
            if row.get("lost")
        ]
        outside = [text.at(row["theta"]) for row in content if row["extrapolated"]]
        if outside:
            said.append(f"Outside the types that the game is made for, results extrapolate: {', '.join(outside)}.")
        beyond = [text.at(row["theta"]) for row in content if row["outside_seen"]]
        if beyond:
            counts = f"{len(beyond)} of {text.counted(len(content), 'type')}"
            said.append(f"{counts} lie outside the box around the trained ones: {', '.join(beyond)}.")
        return said


def verdict(rows: Sequence[Mapping[str, Any]]) -> str:
    """The totals over all types in one sentence."""
    whole = pooled(rows)
    if whole.rate is None:
        return "No start has a safe equilibrium: there is no collision rate (n/a)."
    collisions, starts = text.counted(whole.collisions, "collision"), text.counted(whole.safe_starts, "safe start")
    worst = ""
    if whole.worst_theta is not None:
        worst = f"; worst {text.percent(whole.worst_rate)} at {text.at(whole.worst_theta)}"
    return f"{collisions} in {starts} ({text.percent(whole.rate)}){worst}."
