"""What is counted: collisions, with exact intervals for their rate."""

from __future__ import annotations

import torch
from scipy.stats import binomtest
from torch import Tensor
from torchmetrics import Metric


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


def clopper_pearson(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float] | None:
    """Exact interval of a binomial rate; None without trials."""
    if trials == 0:
        return None
    interval = binomtest(successes, trials).proportion_ci(confidence, method="exact")
    return float(interval.low), float(interval.high)
