"""Time meshes, one per trajectory, that are fine where players meet."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from hno.games import Game


class Mesh(NamedTuple):
    """Time nodes of a batch of trajectories; every label node is one of them."""

    t: Tensor
    """Increasing times, s, (B, K)."""
    label_index: Tensor
    """Places of the label nodes among the nodes, (B, L)."""

    @property
    def step(self) -> Tensor:
        """Interval lengths, s, (B, K - 1)."""
        return self.t.diff(dim=-1)


def label_times(game: Game, *, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The uniform label grid from 0 to the horizon, s, shape (L,)."""
    steps = round(game.horizon / game.label_step)
    return torch.linspace(0, game.horizon, steps + 1, dtype=dtype, device=device)


def graded_mesh(labels: Tensor, weight: Tensor, extra: int) -> Mesh:
    """Split every label interval into as many equal parts as its share of a weight asks for.

    Args:
        labels: label times, s, (L,).
        weight: how many of the extra nodes each label interval deserves, up to a factor, (B, L - 1).
        extra: number of nodes to add in total.
    """
    share = weight.cumsum(-1) / weight.sum(-1, keepdim=True)
    added = torch.nn.functional.pad((extra * share).round(), (1, 0))
    index = added + torch.arange(len(labels), dtype=labels.dtype, device=labels.device)
    nodes = torch.arange(len(labels) + extra, dtype=labels.dtype, device=labels.device)
    t = interpolate(index, labels.expand_as(index), nodes.expand(len(weight), -1))
    return Mesh(t, index.long())


def interpolate(xs: Tensor, ys: Tensor, at: Tensor) -> Tensor:
    """Piecewise linear interpolation along the last axis.

    Args:
        xs: increasing abscissae, (B, F).
        ys: ordinates, (B, F).
        at: where to evaluate, (B, M).
    """
    right = torch.searchsorted(xs.contiguous(), at.contiguous()).clamp(1, xs.shape[-1] - 1)
    low, high = xs.gather(-1, right - 1), xs.gather(-1, right)
    return torch.lerp(ys.gather(-1, right - 1), ys.gather(-1, right), (at - low) / (high - low))
