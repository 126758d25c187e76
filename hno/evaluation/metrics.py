"""What is measured over many episodes or points, and exact intervals of rates."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from scipy.special import betaincinv
from torch import Tensor

from hno.games import Box


def quantiles(values: Tensor, shares: Sequence[float]) -> Tensor:
    """Quantiles of numbers, each one of them: the lower of two neighbours.

    Args:
        values: the numbers, (B,).
        shares: which quantiles, in [0, 1].

    Returns:
        float64, (shares,); NaN without any number, or with a NaN among them.
    """
    at = torch.tensor(shares, dtype=torch.float64, device=values.device)
    if len(values) == 0:
        return torch.full_like(at, torch.nan)
    return values.double().quantile(at, interpolation="lower")


def saturated_share(u: Tensor, box: Box, tolerance: float = 1e-4) -> float | None:
    """Share of controls that lie on a bound of their box, over episodes, steps, players and controls.

    Args:
        u: controls, (B, K, P, m).
        box: of the controls of each player, (m,) or (P, m).
        tolerance: distance from a bound that counts as on it, in widths of the box.

    Returns:
        The share; None without controls.
    """
    inside = torch.minimum(u - box.lo, box.hi - u) / box.width
    return float((inside <= tolerance).double().mean()) if inside.numel() else None


def binned_mean(values: Tensor, place: Tensor, bins: int) -> Tensor:
    """Mean of absolute values in each of several bins.

    Args:
        values: (B, ...).
        place: bin of each row, (B,).
        bins: how many there are.

    Returns:
        float64, (bins,); NaN where a bin is empty.
    """
    rows = values.abs().double().flatten(1)
    total = torch.zeros(bins, dtype=torch.float64, device=rows.device).index_add(0, place, rows.sum(-1))
    return total / (rows.shape[-1] * torch.bincount(place, minlength=bins))


def clopper_pearson(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float] | None:
    """Exact interval of a binomial rate; None without trials."""
    if trials == 0:
        return None
    tail, failures = (1 - confidence) / 2, trials - successes
    low = betaincinv(successes, failures + 1, tail) if successes else 0.0
    high = betaincinv(successes + 1, failures, 1 - tail) if failures else 1.0
    return float(low), float(high)
