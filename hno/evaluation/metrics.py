"""What is measured over many episodes or points, and exact intervals of rates."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from scipy.stats import binomtest
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from hno.games import Box


class CollisionRate(Metric):
    """Share of counted episodes that collide; NaN when none is counted."""

    full_state_update = False
    collisions: Tensor
    episodes: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.add_state("collisions", torch.tensor(0), dist_reduce_fx="sum")
        self.add_state("episodes", torch.tensor(0), dist_reduce_fx="sum")

    def update(self, clearance: Tensor, counted: Tensor) -> None:
        """Add episodes.

        Args:
            clearance: smallest -constraint of each, (B,); a collision is whatever is not above 0, NaN too.
            counted: which of them count, (B,).
        """
        self.collisions += (~(clearance > 0) & counted).sum()
        self.episodes += counted.sum()

    def compute(self) -> Tensor:
        """The share."""
        return self.collisions / self.episodes


class Quantiles(Metric):
    """Quantiles of numbers, each one of them (the lower of two neighbours); NaN without any, or with a NaN among them.

    Args:
        shares: which quantiles, in [0, 1].
    """

    full_state_update = False
    values: list[Tensor]
    shares: Tensor

    def __init__(self, shares: Sequence[float]) -> None:
        super().__init__()
        self.register_buffer("shares", torch.tensor(shares, dtype=torch.float64))
        self.add_state("values", [], dist_reduce_fx="cat")

    def update(self, values: Tensor) -> None:
        """Add numbers, (B,)."""
        self.values.append(values.double())

    def compute(self) -> Tensor:
        """The quantiles, (shares,)."""
        values = dim_zero_cat(self.values) if self.values else self.shares.new_empty(0)
        if len(values) == 0:
            return torch.full_like(self.shares, torch.nan)
        return values.quantile(self.shares, interpolation="lower")


class SaturatedShare(Metric):
    """Share of controls that lie on a bound of their box, of every step, player and control of the counted episodes.

    Args:
        box: of controls.
        tolerance: distance from a bound that counts as on it, in widths of the box.
    """

    full_state_update = False
    saturated: Tensor
    controls: Tensor

    def __init__(self, box: Box, tolerance: float = 1e-4) -> None:
        super().__init__()
        self.box, self.tolerance = box, tolerance
        self.add_state("saturated", torch.tensor(0), dist_reduce_fx="sum")
        self.add_state("controls", torch.tensor(0), dist_reduce_fx="sum")

    def update(self, u: Tensor, counted: Tensor) -> None:
        """Add episodes.

        Args:
            u: controls, (B, K, P, m).
            counted: which episodes count, (B,).
        """
        inside = torch.minimum(u - self.box.lo, self.box.hi - u)[counted] / self.box.width
        self.saturated += (inside <= self.tolerance).sum()
        self.controls += inside.numel()

    def compute(self) -> Tensor:
        """The share; NaN when none is counted."""
        return self.saturated / self.controls


class BinnedMean(Metric):
    """Mean of absolute values in each of several bins, NaN where a bin is empty.

    Args:
        bins: how many.
    """

    full_state_update = False
    total: Tensor
    count: Tensor

    def __init__(self, bins: int) -> None:
        super().__init__()
        self.add_state("total", torch.zeros(bins, dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros(bins, dtype=torch.int64), dist_reduce_fx="sum")

    def update(self, values: Tensor, place: Tensor) -> None:
        """Add numbers.

        Args:
            values: (B, ...).
            place: bin of each row, (B,).
        """
        rows = values.abs().double().flatten(1)
        self.total.index_add_(0, place, rows.sum(-1))
        self.count += rows.shape[-1] * torch.bincount(place, minlength=len(self.count))

    def compute(self) -> Tensor:
        """The means, (bins,)."""
        return self.total / self.count


def clopper_pearson(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float] | None:
    """Exact interval of a binomial rate; None without trials."""
    if trials == 0:
        return None
    interval = binomtest(successes, trials).proportion_ci(confidence, method="exact")
    return float(interval.low), float(interval.high)
