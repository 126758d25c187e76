"""What came of some episodes: how safe they were and what they cost, compared with the labels of their starts."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from hno.control.questions import outside
from hno.data.certificates import inevitable, marginal, safe
from hno.evaluation.metrics import clopper_pearson, quantiles, saturated_share
from hno.games import Game
from hno.types import Extremal, Status, Trajectory, join

SHARES = (0.05, 0.25, 0.5)
"""Quantiles of the smallest distance that are reported."""


class Outcome(NamedTuple):
    """What came of some episodes; numbers that do not exist or are not finite are None.

    A start counts if its equilibrium is safe: it keeps a stated clearance. All numbers but the first five are over
    these starts. There is a field for every entry that results.json has of them, hence so many.
    """

    starts: int
    """Start states asked for."""
    unsolved: int
    """Starts without a converged label."""
    inevitable: int
    """Starts whose equilibrium collides."""
    marginal: int
    """Starts whose equilibrium does not collide but keeps less than the stated clearance."""
    marginal_collisions: int
    """Collisions among those."""
    safe_starts: int
    """Starts that count."""
    collisions: int
    """Collisions, between steps too."""
    rate: float | None
    """Collisions per safe start."""
    interval: tuple[float, float] | None
    """Clopper-Pearson 95 % interval of the rate."""
    median_min_distance: float | None
    """Median of the smallest distance between players, m."""
    distance_quantiles: tuple[float, ...] | None
    """5 %, 25 % and 50 % quantiles of the smallest distance between players, m."""
    median_excess_cost: float | None
    """Median of the joint cost above the label's."""
    largest_excess_cost: float | None
    """Largest of the joint cost above the label's."""
    median_excess_costs: tuple[float, ...] | None
    """Median of each player's own cost above the label's."""
    median_label_cost: float | None
    """Median of the label's joint cost."""
    saturated: float | None
    """Share of controls on a bound of their box, over steps, players and controls."""
    outside: float | None = None
    """Share of steps at which a player is outside the PDE box, where nothing was learned."""
    lost: int = 0
    """Episodes that do not stay finite; they count as collisions."""


class Played(NamedTuple):
    """What is kept of B episodes: numbers without paths, which would not fit into memory for very many."""

    label: Extremal
    """The labels of their starts, of whose courses only the values at the first node are left."""
    value: Tensor
    """Minus the cost of each player, shape (B, P)."""
    distance: Tensor
    """Smallest distance between players, m, shape (B,)."""
    clearance: Tensor
    """Smallest value of -constraint, shape (B,)."""
    collided: Tensor
    """Whether they collide, shape (B,)."""
    lost: Tensor
    """Whether they do not stay finite, shape (B,)."""
    saturated: Tensor
    """Share of controls on a bound of their box, shape (B,)."""
    outside: Tensor
    """Share of steps at which a player is outside the PDE box, shape (B,)."""


def numbers_of(game: Game, label: Extremal, paths: Trajectory) -> Played:
    """What is kept of episodes that were played from the starts of labels, B rows of each."""
    none = {name: getattr(label, name)[:, :0].clone() for name in ("x", "costate", "u", "potential")}
    return Played(
        label._replace(t=label.t[:1], value=label.value[:, :1].clone(), **none),
        paths.value,
        paths.distance,
        paths.clearance,
        paths.collided,
        paths.lost,
        saturated_share(paths.u, game.control_box),
        outside(game, paths.x[:, :-1]).double().mean(1),
    )


def outcome(played: Played, clearance: float) -> Outcome:
    """What came of episodes.

    A start counts if its label keeps the clearance, which is in the unit of the game's constraint.
    """
    labels = played.label
    counted, near = safe(labels, clearance), marginal(labels, clearance)
    count, collisions = int(counted.sum()), int((played.collided & counted).sum())
    own = (labels.value[:, 0] - played.value.double())[counted]
    joint, distances = quantiles(own.sum(-1), (0.5, 1)), _finite(quantiles(played.distance[counted], SHARES))
    return Outcome(
        starts=len(labels.status),
        unsolved=int((labels.status != Status.CONVERGED).sum()),
        inevitable=int(inevitable(labels).sum()),
        marginal=int(near.sum()),
        marginal_collisions=int((played.collided & near).sum()),
        safe_starts=count,
        collisions=collisions,
        rate=collisions / count if count else None,
        interval=clopper_pearson(collisions, count),
        median_min_distance=None if distances is None else distances[-1],
        distance_quantiles=distances,
        median_excess_cost=_finite(joint[0]),
        largest_excess_cost=_finite(joint[1]),
        median_excess_costs=_finite(quantiles(own, (0.5,))[0]),
        median_label_cost=_finite(quantiles(labels.cost[counted], (0.5,))[0]),
        saturated=float(played.saturated[counted].mean()) if count else None,
        outside=float(played.outside[counted].mean()) if count else None,
        lost=int((played.lost & counted).sum()),
    )


def outcomes(played: Sequence[Played], clearance: float) -> tuple[list[Outcome], Outcome]:
    """What came of the episodes of every type, and of all of them together."""
    labels, *columns = zip(*played, strict=True)
    whole = Played(join(labels), *map(torch.cat, columns))
    return [outcome(one, clearance) for one in played], outcome(whole, clearance)


def _finite(values: Tensor) -> Any:
    """A number, or a tuple of them; None if one is not finite."""
    if not bool(values.isfinite().all()):
        return None
    return tuple(values.tolist()) if values.dim() else float(values)


class Pooled(NamedTuple):
    """The outcomes of several types in one line; numbers that do not exist are None."""

    collisions: int
    """Over all types."""
    safe_starts: int
    """Starts that count, over all types."""
    rate: float | None
    """Collisions per safe start."""
    interval: tuple[float, float] | None
    """Clopper-Pearson 95 % interval of the rate."""
    worst_theta: tuple[float, ...] | None
    """The types with the highest rate, the first ones where several share it; None where nothing collides."""
    worst_rate: float | None
    """The highest rate of any types."""
    relative_excess: float | None
    """Median over types of (median joint cost above the equilibrium's) / (median of the equilibrium's)."""


def pooled(rows: Sequence[Mapping[str, Any]]) -> Pooled:
    """Outcomes by type in one line.

    Args:
        rows: "theta", the counts and, if costs are asked for, the median costs of an `Outcome` for each type, such as
            the rows of results.json's `table`.
    """
    played = [row for row in rows if row["safe_starts"]]
    collisions, count = (sum(row[name] for row in played) for name in ("collisions", "safe_starts"))
    worst = max(played, key=lambda row: row["collisions"] / row["safe_starts"], default=None)
    costs = [(row.get("median_excess_cost"), row.get("median_label_cost")) for row in played]
    ratios = [above / abs(cost) for above, cost in costs if above is not None and cost]
    return Pooled(
        collisions=collisions,
        safe_starts=count,
        rate=collisions / count if count else None,
        interval=clopper_pearson(collisions, count),
        worst_theta=tuple(worst["theta"]) if worst is not None and collisions else None,
        worst_rate=None if worst is None else worst["collisions"] / worst["safe_starts"],
        relative_excess=statistics.median(ratios) if ratios else None,
    )
