"""How safe a policy is, type by type, on starts whose equilibrium is safe."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from hno.evaluation.metrics import CollisionRate, clopper_pearson
from hno.evaluation.rollout import Disturbance, Policy, rollout
from hno.games import Game
from hno.types import Extremal, Status, Trajectory


class TypeRow(NamedTuple):
    """One line of the collision table; numbers that do not exist are None."""

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


def play(
    game: Game,
    policy: Policy,
    labels: Sequence[Extremal],
    dt: float = 0.02,
    disturbance: Disturbance = Disturbance(),
) -> Trajectory:
    """Roll out a policy from the start states of labels, one set after the other.

    Args:
        game: the game.
        policy: feedback controls of all players.
        labels: one set per type.
        dt: time for which a control is held, s.
        disturbance: of the controls.
    """
    starts = torch.cat([found.x[:, 0] for found in labels]).float()
    types = torch.cat([found.theta for found in labels]).float()
    return rollout(game, policy, starts, types, dt, disturbance=disturbance)


def collision_table(
    game: Game,
    policy: Policy,
    labels: Sequence[Extremal],
    seen: Sequence[Sequence[float]],
    clearance: float = 0.02,
    dt: float = 0.02,
    disturbance: Disturbance = Disturbance(),
) -> list[TypeRow]:
    """`table_of` what the policy plays; arguments as there and in `play`."""
    return table_of(play(game, policy, labels, dt, disturbance), labels, seen, clearance)


def table_of(
    played: Trajectory,
    labels: Sequence[Extremal],
    seen: Sequence[Sequence[float]],
    clearance: float = 0.02,
) -> list[TypeRow]:
    """Compare episodes with the equilibria from the same starts, type by type.

    Args:
        played: what `play` returned for these labels.
        labels: one set per type.
        seen: types that the operator was trained with.
        clearance: what the label must keep for its start to count, m for distance constraints.
    """
    sizes = [len(found.status) for found in labels]
    known = {tuple(float(t) for t in theta) for theta in seen}
    parts = (played.clearance.split(sizes), played.distance.split(sizes), played.value.split(sizes))
    return [
        _row(found, gap, distance, value, known, clearance)
        for found, gap, distance, value in zip(labels, *parts, strict=True)
    ]


def _row(
    found: Extremal, played: Tensor, distance: Tensor, value: Tensor, seen: set[tuple[float, ...]], clearance: float
) -> TypeRow:
    theta = tuple(float(t) for t in found.theta[0])
    solved = found.status == Status.CONVERGED
    safe, marginal = classify(found, clearance)
    metric = CollisionRate()
    metric.update(played, safe)
    collisions, counted = int(metric.collisions), int(metric.episodes)
    label_cost = -found.value[:, 0].sum(-1)
    excess = -value.sum(-1).double() - label_cost
    return TypeRow(
        theta=theta,
        seen=theta in seen,
        starts=len(solved),
        unsolved=int((~solved).sum()),
        inevitable=int((solved & (found.clearance <= 0)).sum()),
        marginal=int(marginal.sum()),
        marginal_collisions=int((marginal & ~(played > 0)).sum()),
        safe_starts=counted,
        collisions=collisions,
        rate=collisions / counted if counted else None,
        interval=clopper_pearson(collisions, counted),
        median_min_distance=_median(distance[safe]),
        median_excess_cost=_median(excess[safe]),
        median_label_cost=_median(label_cost[safe]),
    )


def classify(found: Extremal, clearance: float) -> tuple[Tensor, Tensor]:
    """Which starts count, and which are safe by less than the stated clearance, each (B,)."""
    solved = found.status == Status.CONVERGED
    safe = solved & (found.clearance >= clearance)
    return safe, solved & (found.clearance > 0) & ~safe


def _median(values: Tensor) -> float | None:
    return float(values.median()) if len(values) else None
