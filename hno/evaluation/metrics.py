"""What is measured over many episodes or points, and exact intervals of rates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from scipy.special import betainccinv, betaincinv
from torch import Tensor

from hno.games import Box
from hno.types import Points

BATCH = 16_384
"""Rows that are computed at once, at most: derivatives of a value function take some 10 kB a row."""


@torch.no_grad()
def in_batches(compute: Callable[[Points], tuple[Tensor, ...]], points: Points) -> Any:
    """What is computed of points, (B, ...) each, batch by batch."""
    columns = zip(*(column.split(BATCH) for column in points), strict=True)
    found = [compute(Points(*batch)) for batch in columns]
    whole = map(torch.cat, zip(*found, strict=True))
    return type(found[0])(*whole) if hasattr(found[0], "_fields") else tuple(whole)


def quantiles(values: Tensor, shares: Sequence[float]) -> Tensor:
    """Quantiles of numbers (B, ...), each one of them, the lower of two neighbours: float64, (shares, ...).

    NaN without any number, or with a NaN among them.
    """
    at = torch.tensor(shares, dtype=torch.float64, device=values.device)
    if len(values) == 0:
        return at.new_full((len(shares), *values.shape[1:]), torch.nan)
    return values.double().quantile(at, 0, interpolation="lower")


def saturated_share(u: Tensor, box: Box, tolerance: float = 1e-4) -> Tensor:
    """Share of controls (B, K, P, m) within `tolerance` widths of a bound of their box, episode by episode, (B,)."""
    inside = torch.minimum(u - box.lo, box.hi - u) / box.width
    return (inside <= tolerance).double().flatten(1).mean(1)


def credible(belief: Tensor, share: float = 0.9) -> Tensor:
    """The smallest set of candidates that has at least a share of the belief, the most likely first, bool, (..., C)."""
    falling, order = belief.sort(dim=-1, descending=True, stable=True)
    before = falling.cumsum(-1) - falling
    return (before < share).take_along_dim(order.argsort(dim=-1), -1)


def clopper_pearson(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float] | None:
    """Exact interval of a binomial rate; None without trials."""
    tail = (1 - confidence) / 2
    return (lower_bound(successes, trials, tail), upper_bound(successes, trials, tail)) if trials else None


def upper_bound(successes: int, trials: int, beta: float) -> float:
    """What a rate exceeds with a probability of at most `beta` (Clopper and Pearson 1934); 1 without trials."""
    return float(betainccinv(successes + 1, trials - successes, beta)) if successes < trials else 1.0


def lower_bound(successes: int, trials: int, beta: float) -> float:
    """What a rate is below with a probability of at most `beta`; 0 without trials."""
    return float(betaincinv(successes, trials - successes + 1, beta)) if successes else 0.0
