"""Time meshes, one per trajectory, that are fine where players meet."""

from __future__ import annotations

import torch
from torch import Tensor

from hno.games import Game


def label_steps(game: Game) -> int:
    """Number of label intervals: as near to the game's label step as whole intervals allow, and at least one."""
    return max(1, round(game.horizon / game.label_step))


def label_times(game: Game, *, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The uniform label grid from 0 to the horizon, s, shape (L,)."""
    return torch.linspace(0, game.horizon, label_steps(game) + 1, dtype=dtype, device=device)


def inner_times(labels: Tensor, points: int = 10) -> Tensor:
    """Times inside each label interval at which `encounter_weight` looks, ends included, s, (L - 1, points + 1)."""
    share = torch.linspace(0, 1, points + 1, dtype=labels.dtype, device=labels.device)
    return torch.lerp(labels[:-1, None], labels[1:, None], share)


def encounter_weight(cost: Tensor) -> Tensor:
    """How much costs of states (B, L - 1, Q, P) vary within each label interval, plus a floor, (B, L - 1)."""
    weight = cost.sum(-1).diff(dim=-1).abs().sum(-1).nan_to_num(0, 0).clamp_min(1e-12).sqrt()
    return weight / weight.amax(-1, keepdim=True) + 0.05


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
