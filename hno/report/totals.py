"""What a collision table says as a whole."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from hno.evaluation.metrics import clopper_pearson


class Totals(NamedTuple):
    """A collision table in one line; numbers that do not exist are None."""

    collisions: int
    """Over all types."""
    safe_starts: int
    """Starts that count, over all types."""
    rate: float | None
    """Collisions per safe start."""
    interval: tuple[float, float] | None
    """Clopper-Pearson 95 % interval of the rate."""
    worst_theta: tuple[float, ...] | None
    """The types with the highest rate, the first ones where several share it; none where nothing collides."""
    worst_rate: float | None
    """The highest rate of any types."""
    excess: float | None
    """Median over types of (median joint cost above the equilibrium's) / (median of the equilibrium's)."""


def totals(table: Sequence[Mapping[str, Any]]) -> Totals:
    """Sum up the rows of results.json's `table`, which are `TypeRow`s as dictionaries."""
    collisions, safe = (sum(row[name] for row in table) for name in ("collisions", "safe_starts"))
    counted = [row for row in table if row["rate"] is not None]
    worst = max(counted, key=lambda row: row["rate"], default=None)
    return Totals(
        collisions=collisions,
        safe_starts=safe,
        rate=collisions / safe if safe else None,
        interval=clopper_pearson(collisions, safe),
        worst_theta=tuple(worst["theta"]) if worst is not None and collisions else None,
        worst_rate=None if worst is None else worst["rate"],
        excess=relative_excess((row["median_excess_cost"], row["median_label_cost"]) for row in counted),
    )


def relative_excess(costs: Iterable[tuple[float | None, float | None]]) -> float | None:
    """Median over types of (cost above the equilibrium's) / (the equilibrium's); None where no type has both."""
    ratios = [above / abs(cost) for above, cost in costs if above is not None and cost]
    return statistics.median(ratios) if ratios else None
