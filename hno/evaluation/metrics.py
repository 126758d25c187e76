"""What is counted: torchmetrics for errors and collisions, exact intervals for rates."""

from __future__ import annotations

import torch
from scipy.stats import binomtest
from torch import Tensor
from torchmetrics import Metric


class RelativeError(Metric):
    """Sum of absolute deviations over the sum of absolute targets: 0 is perfect, 1 is as bad as predicting 0."""

    full_state_update = False
    deviation: Tensor
    size: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.add_state("deviation", torch.tensor(0.0, dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("size", torch.tensor(0.0, dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, predicted: Tensor, target: Tensor) -> None:
        """Add tensors of any equal shape."""
        self.deviation += (predicted - target).abs().sum().double()
        self.size += target.abs().sum().double()

    def compute(self) -> Tensor:
        """The ratio."""
        return self.deviation / self.size


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
            clearance: smallest -constraint of each, (B,); a collision is 0 or less.
            counted: which of them count, (B,).
        """
        self.collisions += ((clearance <= 0) & counted).sum()
        self.episodes += counted.sum()

    def compute(self) -> Tensor:
        """The share."""
        return self.collisions / self.episodes


def clopper_pearson(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float] | None:
    """Exact interval of a binomial rate; None without trials."""
    if trials == 0:
        return None
    interval = binomtest(successes, trials).proportion_ci(confidence, method="exact")
    return float(interval.low), float(interval.high)
