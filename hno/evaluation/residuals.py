"""Where a value function satisfies the Hamilton-Jacobi-Isaacs equation, and where it does not."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from hno.data.rows import rows_of
from hno.data.sources import Known, Pool, make_sampler, sample_points
from hno.evaluation import format as text
from hno.evaluation.metrics import in_batches
from hno.evaluation.sections import Column, Evaluation, ModelSection, sections
from hno.games import Game
from hno.losses.hji import HJIResidual
from hno.operators import ValueOperator
from hno.types import Extremal, Points, Sample, Status

REGIONS = ("start box", "PDE box", "constraint band", "around labels", "along labels")
"""Uniform starts at the beginning; uniform in the PDE box; near the surface constraint = 0; nodes of labels with noise,
as the sampler of collocation points makes them (`hno.data.sources`); the nodes themselves."""
BINS = 4
"""Equal parts of the horizon by which residuals are reported."""


class ResidualRow(NamedTuple):
    """The HJI residual of one type in one region, a field for every entry of results.json; None where it is missing."""

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
    known = {tuple(map(float, theta)) for theta in seen}
    return [
        ResidualRow(theta, theta in known, region, len(where.tau), *_means(operator, where, bins))
        for found, theta in ((found, tuple(found.theta[0].tolist())) for found in labels)
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
        yield from [Points(types[:0, 0], found.x[:0, 0].float(), types[:0])] * 2


def _means(operator: ValueOperator, where: Points, bins: int) -> tuple[Any, ...]:
    """The fields of a `ResidualRow` after `points`."""
    horizon = operator.game.horizon
    place = (where.tau / horizon * bins).long().clamp(0, bins - 1)
    nothing = where.theta, where.theta
    residual, scale = in_batches(functools.partial(hji, operator), where) if len(where.tau) > 0 else nothing
    inside = [place == k for k in range(bins)]
    kinds = residual, residual / scale
    return (
        *map(_mean, kinds),
        tuple(horizon * k / bins for k in range(bins + 1)),
        tuple(int(rows.sum()) for rows in inside),
        *(tuple(_mean(kind[rows]) for rows in inside) for kind in kinds),
    )


def _mean(values: Tensor) -> float | None:
    """Mean of absolute values; None without any, or where one is no number."""
    found = float(values.abs().double().mean())
    return None if math.isnan(found) else found


@torch.no_grad()
def hji(operator: ValueOperator, points: Points) -> tuple[Tensor, Tensor]:
    """The HJI residual, 1/s, and the size that the loss measures it in, both (B, P)."""
    term, view = HJIResidual(), operator.view(Sample(points), operator.field(points))
    residual = term.residual(view)
    return residual, term.scale(view).expand_as(residual)


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
        operator, seed = evaluation.policy.operator, evaluation.options["seed"]
        return [row._asdict() for row in residual_table(operator, evaluation.labels, evaluation.seen, seed=seed)]

    def rows(self, content: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """One line per region for the seen types and one for the unseen ones."""
        groups = dict.fromkeys((row["region"], seen) for row in content for seen in (True, False))
        found = {group: [row for row in content if (row["region"], row["seen"]) == group] for group in groups}
        return [_together(*group, rows) for group, rows in found.items() if rows]


def _together(region: str, seen: bool, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The line of several types: means over all of their points."""
    counts = [row["points"] for row in rows]
    bins = (zip(*(row[name] for row in rows), strict=True) for name in ("scaled_by_tau", "points_by_tau"))
    return {
        "region": region,
        "types": f"{len(rows)} {'seen' if seen else 'unseen'}",
        "points": sum(counts),
        **{name: _weighted([row[name] for row in rows], counts) for name in ("physical", "scaled")},
        "scaled_by_tau": [_weighted(*pair) for pair in zip(*bins, strict=True)],
    }


def _weighted(means: Sequence[float | None], counts: Sequence[int]) -> float | None:
    """Mean over everything that several means are over; None where there is nothing."""
    pairs = [(mean, count) for mean, count in zip(means, counts, strict=True) if mean is not None and count]
    return sum(mean * count for mean, count in pairs) / sum(count for _, count in pairs) if pairs else None
