"""What a network is fed with: states as each player sees them, and each type once."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

from hno.types import Types


def ego_views(x: Tensor, *, inverse: bool = False) -> Tensor:
    """Each player's view of a joint quantity, itself first.

    Args:
        x: (B, P, n), or (B, P, P, n) with one copy per player already (needed for the inverse).
        inverse: turn views back into the common order.

    Returns:
        (B, P, P, n); entry [..., i, j, :] is player (i + j) mod P, or its inverse.
    """
    players = x.shape[-2]
    if not inverse:
        return torch.stack([x.roll(-i, -2) for i in range(players)], -3)
    return torch.stack([x[..., i, :, :].roll(i, -2) for i in range(players)], -3)


def distinct_types(theta: Tensor) -> Types:
    """The different types among (B, P) as a table; this waits for the device."""
    distinct, which = theta.reshape(-1, theta.shape[-1]).unique(dim=0, return_inverse=True)
    return Types(distinct, which)


def tables(parts: Sequence[Types]) -> Types:
    """One table for several batches of points, one after the other."""
    offsets = itertools.accumulate((len(part.distinct) for part in parts), initial=0)
    which = [part.which + offset for part, offset in zip(parts, offsets, strict=False)]
    return Types(torch.cat([part.distinct for part in parts]), torch.cat(which))
