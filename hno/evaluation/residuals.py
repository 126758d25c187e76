"""Where a value function satisfies the Hamilton-Jacobi-Isaacs equation, and where it does not."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from hno.data.rows import rows_of
from hno.data.sources import Known, Pool, make_sampler, sample_points
from hno.evaluation import format as text
from hno.evaluation.metrics import binned_mean
from hno.evaluation.sections import Column, Evaluation, ModelSection, sections
from hno.games import Game
from hno.losses import View
from hno.losses.hji import HJIResidual
from hno.operators import ValueOperator
from hno.types import Extremal, Points, Sample, Status

REGIONS = ("start box", "PDE box", "constraint band", "around labels", "along labels")
"""Uniform starts at the beginning; uniform in the PDE box; near the surface constraint = 0; nodes of labels with noise,
as the sampler of collocation points makes them (`hno.data.sampling`); the nodes themselves."""
BINS = 4
"""Equal parts of the horizon by which residuals are reported."""


class ResidualRow(NamedTuple):
    """The HJI residual at one type in one region; numbers that do not exist are None."""

    theta: tuple[float, ...]
    """Player types."""
    seen: bool
    """Whether the operator was trained with labels of these types."""
    region: str
    """One of `REGIONS`."""
    points: int
    """How many points; 0 at labels of which none converged."""
    physical: float | None
    """Mean over points and players of the residual's absolute value, 1/s."""
    scaled: float | None
    """The same of the residual as the loss scales it: relative to values per horizon plus the penalty at the point."""
    tau: tuple[float, ...]
    """Edges of bins of time to go, s."""
    points_by_tau: tuple[int, ...]
    """Points in each bin."""
    physical_by_tau: tuple[float | None, ...]
    """As `physical`, bin by bin."""
    scaled_by_tau: tuple[float | None, ...]
    """As `scaled`, bin by bin."""


def residual_table(
    operator: ValueOperator,
    labels: Sequence[Extremal],
    seen: Sequence[Sequence[float]],
    points: int = 4096,
    seed: int = 0,
    bins: int = BINS,
) -> list[ResidualRow]:
    """The residual by type, region and time to go.

    Args:
        operator: the value function.
        labels: one set per type; the converged ones are a region.
        seen: types that the operator was trained with.
        points: in each other region.
        seed: of the points, which are the same whatever other types there are.
        bins: of time to go.
    """
    known = {tuple(float(t) for t in theta) for theta in seen}
    return [
        _row(operator, tuple(float(t) for t in found.theta[0]), known, region, where, bins)
        for found in labels
        for region, where in zip(REGIONS, _regions(operator.game, found, points, seed), strict=True)
    ]


def _regions(game: Game, found: Extremal, size: int, seed: int) -> Iterator[Points]:
    """Points of each of `REGIONS`, each from the same seed."""
    types = found.theta[:1].float().expand(size, -1)

    def sampled(source: str, labels: Pool | None = None) -> Points:
        known = Known(labels, None)
        return sample_points(game, types, make_sampler({source: 1.0}), known, 1.0, torch.Generator().manual_seed(seed))

    starts = game.initial_box.sample(size, torch.Generator().manual_seed(seed))
    yield Points(torch.full((size,), game.horizon), starts, types)
    yield sampled("box")
    yield sampled("band")
    if bool((found.status == Status.CONVERGED).any()):
        nodes = rows_of(game, [found]).points
        yield sampled("labels", Pool(nodes.tau, nodes.x))
        yield nodes
    else:
        nothing = Points(types[:0, 0], found.x[:0, 0].float(), types[:0])
        yield from (nothing, nothing)


def _row(
    operator: ValueOperator,
    theta: tuple[float, ...],
    seen: set[tuple[float, ...]],
    region: str,
    where: Points,
    bins: int,
) -> ResidualRow:
    horizon = operator.game.horizon
    place = (where.tau / horizon * bins).long().clamp(0, bins - 1)
    residual, scale = hji(operator, where) if len(where.tau) > 0 else (where.theta, where.theta)
    scaled = residual / scale
    return ResidualRow(
        theta=theta,
        seen=theta in seen,
        region=region,
        points=len(where.tau),
        physical=_number(residual.abs().double().mean()),
        scaled=_number(scaled.abs().double().mean()),
        tau=tuple(horizon * k / bins for k in range(bins + 1)),
        points_by_tau=tuple(torch.bincount(place, minlength=bins).tolist()),
        physical_by_tau=tuple(map(_number, binned_mean(residual, place, bins))),
        scaled_by_tau=tuple(map(_number, binned_mean(scaled, place, bins))),
    )


@torch.no_grad()
def hji(operator: ValueOperator, points: Points) -> tuple[Tensor, Tensor]:
    """The HJI residual, 1/s, and the size that the loss measures it in, both (B, P)."""
    term, field = HJIResidual(), operator.field(points)
    view = View(operator.game, Sample(points), field, operator.field, operator.scales, 0)
    residual = term.residual(view)
    return residual, term.scale(view).expand_as(residual)


def _number(value: Tensor) -> float | None:
    return None if bool(value.isnan()) else float(value)


@sections.register("residuals")
class Residuals(ModelSection):
    """The HJI residual by type, region and time to go."""

    heading = "HJI residual"
    note = (
        "scaled: relative to values per horizon plus the local penalty, as in the loss; "
        "by time to go: scaled, in equal parts of the horizon from its end"
    )
    columns = (
        Column("region", "region"),
        Column("types", "types"),
        Column("points", "points", format=text.whole),
        Column("physical", "mean", "1/s", text.significant),
        Column("scaled", "scaled", format=text.significant),
        Column("scaled_by_tau", "by time to go", format=lambda parts: ", ".join(map(text.significant, parts))),
    )

    def compute(self, evaluation: Evaluation) -> list[dict[str, Any]]:
        """One line per type and region."""
        seed = evaluation.condition.disturbance.seed
        rows = residual_table(evaluation.operator, evaluation.labels, evaluation.seen, seed=seed)
        return [row._asdict() for row in rows]

    def rows(self, content: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """One line per region for the seen types and one for the unseen ones."""
        groups: dict[tuple[str, bool], list[Mapping[str, Any]]] = {}
        for row in content:
            groups.setdefault((row["region"], row["seen"]), []).append(row)
        regions = list(dict.fromkeys(row["region"] for row in content))
        ordered = sorted(groups.items(), key=lambda group: (regions.index(group[0][0]), not group[0][1]))
        return [
            {
                "region": region,
                "types": f"{len(same)} {'seen' if seen else 'unseen'}",
                "points": sum(row["points"] for row in same),
                **{name: _weighted(same, name, "points") for name in ("physical", "scaled")},
                "scaled_by_tau": _weighted_bins(same),
            }
            for (region, seen), same in ordered
        ]


def _weighted_bins(rows: Sequence[Mapping[str, Any]]) -> list[float | None]:
    """Means of the scaled residual over all points of each bin."""
    names = ("scaled_by_tau", "points_by_tau")
    bins = [dict(zip(names, pair, strict=True)) for row in rows for pair in zip(*map(row.get, names), strict=True)]
    count = len(rows[0]["points_by_tau"])
    return [_weighted(bins[place::count], *names) for place in range(count)]


def _weighted(rows: Sequence[Mapping[str, Any]], name: str, count: str) -> float | None:
    """Mean over everything that several means are over; None where there is nothing."""
    pairs = [(row[name], row[count]) for row in rows if row[name] is not None and row[count]]
    return sum(value * size for value, size in pairs) / sum(size for _, size in pairs) if pairs else None
