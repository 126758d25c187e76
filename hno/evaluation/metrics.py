"""What is measured over many episodes or points, and exact intervals of rates."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from scipy.special import betaincinv
from torch import Tensor

from hno.games import Box


def quantiles(values: Tensor, shares: Sequence[float]) -> Tensor:
    """Quantiles of numbers (B, ...), each one of them, the lower of two neighbours: float64, (shares, ...).

    NaN without any number, or with a NaN among them.
    """
    at = torch.tensor(shares, dtype=torch.float64, device=values.device)
    if len(values) == 0:
        return at.new_full((len(shares), *values.shape[1:]), torch.nan)
    return values.double().quantile(at, 0, interpolation="lower")


def saturated_share(u: Tensor, box: Box, tolerance: float = 1e-4) -> float | None:
    """Share of controls (B, K, P, m) within `tolerance` widths of a bound of their box; None without controls."""
    inside = torch.minimum(u - box.lo, box.hi - u) / box.width
    return float((inside <= tolerance).double().mean()) if inside.numel() else None


def clopper_pearson(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float] | None:
    """Exact interval of a binomial rate; None without trials."""
    if trials == 0:
        return None
    tail, failures = (1 - confidence) / 2, trials - successes
    low = betaincinv(successes, failures + 1, tail) if successes else 0.0
    high = betaincinv(successes + 1, failures, 1 - tail) if failures else 1.0
    return float(low), float(high)
