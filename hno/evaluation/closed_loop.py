"""How safe a policy is, type by type, on starts whose equilibrium is safe."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torchmetrics import WeightedMeanAbsolutePercentageError

from hno.control.rollout import Disturbance, Player, rollout
from hno.data.rows import rows_of
from hno.evaluation.metrics import CollisionRate, Quantiles, SaturatedShare, clopper_pearson
from hno.games import Game
from hno.types import Extremal, Field, Points, Status, Trajectory

ValueField = Callable[[Points], Field]
"""A value function with its derivatives, such as `ValueOperator.field`."""
SHARES = (0.05, 0.25, 0.5)
"""Quantiles of the smallest distance that are reported."""


class TypeRow(NamedTuple):
    """One line of the collision table; numbers that do not exist or are not finite are None."""

    theta: tuple[float, ...]
    """Player types."""
    seen: bool
    """Whether the operator was trained with labels of these types."""
    starts: int
    """Start states asked for."""
    unsolved: int
    """Starts without a converged label; they do not count."""
    inevitable: int
    """Starts whose equilibrium collides; they do not count."""
    marginal: int
    """Starts whose equilibrium is safe but keeps less than the stated clearance; counted apart."""
    marginal_collisions: int
    """Collisions among those."""
    safe_starts: int
    """Starts that count."""
    collisions: int
    """Collisions among those, between steps too."""
    rate: float | None
    """Collisions per safe start."""
    interval: tuple[float, float] | None
    """Clopper-Pearson 95 % interval of the rate."""
    median_min_distance: float | None
    """Median over safe starts of the smallest distance between players, m."""
    median_excess_cost: float | None
    """Median over safe starts of the joint cost above the label's."""
    median_label_cost: float | None
    """Median over safe starts of the label's joint cost."""
    distance_quantiles: tuple[float, ...] | None = None
    """5 %, 25 % and 50 % quantiles over safe starts of the smallest distance between players, m."""
    median_excess_costs: tuple[float, ...] | None = None
    """Median over safe starts of each player's own cost above the label's."""
    saturated: float | None = None
    """Share of controls on a bound of their box, over steps, players and controls of safe starts."""
    value_error: float | None = None
    """Weighted absolute percentage error of values at the nodes of converged labels, as a fraction."""
    costate_error: float | None = None
    """The same of all costates."""
    extrapolated: bool = False
    """Whether the types lie outside the range that the game is made for."""
    outside_seen: bool = False
    """Whether they lie outside the smallest box around the types that the operator was trained with, if any."""


def collision_table(
    game: Game,
    policy: Player,
    labels: Sequence[Extremal],
    seen: Sequence[Sequence[float]],
    clearance: float = 0.02,
    dt: float = 0.02,
    disturbance: Disturbance = Disturbance(),
    field: ValueField | None = None,
) -> list[TypeRow]:
    """Roll out a policy from the start states of labels and compare.

    Args:
        game: the game.
        policy: feedback controls of all players.
        labels: one set per type.
        seen: types that the operator was trained with.
        clearance: what the label must keep for its start to count, m for distance constraints.
        dt: time for which a control is held, s.
        disturbance: of the episodes.
        field: the policy's value function, if it has one.
    """
    return tabulate(game, labels, play(game, policy, labels, dt, disturbance), seen, clearance, field)


def play(
    game: Game, policy: Player, labels: Sequence[Extremal], dt: float, disturbance: Disturbance = Disturbance()
) -> list[Trajectory]:
    """Episodes from the start states of labels, one set per set of labels. See `collision_table`."""
    starts = torch.cat([found.x[:, 0] for found in labels]).float()
    types = torch.cat([found.theta for found in labels]).float()
    played = rollout(game, policy, starts, types, dt, disturbance=disturbance)
    sizes = [len(found.status) for found in labels]
    columns = zip(*(column.split(sizes) for column in played[1:]), strict=True)
    return [Trajectory(played.t, *part) for part in columns]


def tabulate(
    game: Game,
    labels: Sequence[Extremal],
    played: Sequence[Trajectory],
    seen: Sequence[Sequence[float]],
    clearance: float,
    field: ValueField | None = None,
) -> list[TypeRow]:
    """The table of episodes that were played from the starts of labels. See `collision_table`."""
    known = {tuple(float(t) for t in theta) for theta in seen}
    return [_row(game, *sets, known, clearance, field) for sets in zip(labels, played, strict=True)]


def _row(
    game: Game,
    found: Extremal,
    played: Trajectory,
    seen: set[tuple[float, ...]],
    clearance: float,
    field: ValueField | None,
) -> TypeRow:
    theta = tuple(float(t) for t in found.theta[0])
    solved = found.status == Status.CONVERGED
    safe, marginal = classify(found, clearance)
    rate, saturated, distance = CollisionRate(), SaturatedShare(game.control_box), Quantiles(SHARES)
    rate.update(played.clearance, safe)
    saturated.update(played.u, safe)
    distance.update(played.distance[safe])
    collisions, counted = int(rate.collisions), int(rate.episodes)
    excess, label_cost = excess_costs(found, played), -found.value[:, 0].sum(-1)
    errors = (None, None) if field is None else label_errors(game, field, found)
    return TypeRow(
        theta=theta,
        seen=theta in seen,
        starts=len(solved),
        unsolved=int((~solved).sum()),
        inevitable=int((solved & (found.clearance <= 0)).sum()),
        marginal=int(marginal.sum()),
        marginal_collisions=int((marginal & collided(played)).sum()),
        safe_starts=counted,
        collisions=collisions,
        rate=collisions / counted if counted else None,
        interval=clopper_pearson(collisions, counted),
        median_min_distance=median(played.distance[safe]),
        median_excess_cost=median(excess.sum(-1)[safe]),
        median_label_cost=median(label_cost[safe]),
        distance_quantiles=_finite(distance.compute()),
        median_excess_costs=_finite(excess[safe].median(0).values) if counted else None,
        saturated=float(saturated.compute()) if counted else None,
        value_error=errors[0],
        costate_error=errors[1],
        extrapolated=not bool(game.type_box.contains(found.theta[0].to(game.type_box.lo))),
        outside_seen=bool(seen) and not _inside_hull(theta, seen),
    )


def _inside_hull(theta: tuple[float, ...], seen: set[tuple[float, ...]]) -> bool:
    """Whether types lie in the smallest box around others."""
    return all(min(column) <= t <= max(column) for t, column in zip(theta, zip(*seen, strict=True), strict=True))


def collided(played: Trajectory) -> Tensor:
    """Which episodes collide, (B,): those that keep no positive clearance, NaN too."""
    return ~(played.clearance > 0)


def excess_costs(found: Extremal, played: Trajectory) -> Tensor:
    """Each player's cost above the label's, (B, P)."""
    return found.value[:, 0] - played.value.double()


def label_errors(game: Game, field: ValueField, found: Extremal) -> tuple[float | None, float | None]:
    """Weighted absolute percentage errors of values and costates at the nodes of converged labels, as in training.

    The sum of absolute errors over the sum of absolute labels; None where no label converged.
    """
    if not bool((found.status == Status.CONVERGED).any()):
        return None, None
    points, labels, _ = rows_of(game, [found])
    assert labels is not None
    told = field(points)
    value, costate = WeightedMeanAbsolutePercentageError(), WeightedMeanAbsolutePercentageError()
    value.update(told.value, labels.value)
    costate.update(told.costate.flatten(1), labels.costate.flatten(1))
    return float(value.compute()), float(costate.compute())


def classify(found: Extremal, clearance: float) -> tuple[Tensor, Tensor]:
    """Which starts count, and which are safe by less than the stated clearance, each (B,)."""
    solved = found.status == Status.CONVERGED
    safe = solved & (found.clearance >= clearance)
    return safe, solved & (found.clearance > 0) & ~safe


def median(values: Tensor) -> float | None:
    """The lower median; None without numbers, or where it is not finite."""
    found = _finite(values.median().reshape(1))
    return None if found is None else found[0]


def _finite(values: Tensor) -> tuple[float, ...] | None:
    """Numbers (N,) as they are stored; None if one is not finite."""
    return tuple(values.tolist()) if bool(values.isfinite().all()) else None
