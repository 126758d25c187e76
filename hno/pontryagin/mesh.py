"""Time meshes, one per trajectory, that are fine where players meet."""

from __future__ import annotations

import torch
from torch import Tensor

from hno.games import Game


def label_times(game: Game, *, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The uniform label grid from 0 to the horizon, s, shape (L,)."""
    steps = round(game.horizon / game.label_step)
    return torch.linspace(0, game.horizon, steps + 1, dtype=dtype, device=device)


def graded_mesh(labels: Tensor, weight: Tensor, extra: int) -> Tensor:
    """Split every label interval into as many equal parts as its share of a weight asks for.

    Args:
        labels: label times, s, (L,).
        weight: how many of the extra nodes each label interval deserves, up to a factor, (B, L - 1).
        extra: number of nodes to add in total.

    Returns:
        Increasing times, s, one mesh per row, (B, L + extra); every label time is one of them.
    """
    share = weight.cumsum(-1) / weight.sum(-1, keepdim=True)
    added = torch.nn.functional.pad((extra * share).round(), (1, 0))
    index = added + torch.arange(len(labels), dtype=labels.dtype, device=labels.device)
    nodes = torch.arange(len(labels) + extra, dtype=labels.dtype, device=labels.device)
    return interpolate(index, labels.expand_as(index), nodes.expand(len(weight), -1))


def label_places(t: Tensor, labels: Tensor) -> Tensor:
    """Places of the label times (L,) among the nodes (B, K) of meshes that hold them, (B, L)."""
    slack = 64 * torch.finfo(t.dtype).eps * t[:, -1:]
    return torch.searchsorted(t.contiguous(), (labels - slack).contiguous())


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
