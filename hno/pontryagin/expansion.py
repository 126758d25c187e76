"""Second-order models of a cost around a trajectory."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Expansion(NamedTuple):
    """Second-order model of a problem around a trajectory, in deviations of states (D) and controls (M)."""

    state_matrix: Tensor
    """d(next state) / d(state), (R, N, D, D)."""
    control_matrix: Tensor
    """d(next state) / d(control), (R, N, D, M)."""
    gradient: Tensor
    """Of the cost in the states, (R, N + 1, D)."""
    hessian: Tensor
    """Of the cost in the states, positive semidefinite, (R, N + 1, D, D)."""
    control_gradient: Tensor
    """Of the cost in the controls, (R, N, M)."""
    control_hessian: Tensor
    """Of the cost in the controls, (R, N, M, M)."""


def block_diagonal(blocks: Tensor) -> Tensor:
    """Players' blocks (..., P, a, b) as one matrix (..., P a, P b)."""
    players, rows, columns = blocks.shape[-3:]
    dense = blocks.new_zeros(*blocks.shape[:-3], players, rows, players, columns)
    dense.diagonal(dim1=-4, dim2=-2).copy_(blocks.movedim(-3, -1))
    return dense.flatten(-4, -3).flatten(-2)


def positive_part(matrix: Tensor) -> Tensor:
    """The nearest positive semidefinite matrices; entries that are not finite count as 0."""
    matrix = matrix.nan_to_num(0, 0, 0)
    size, axes = torch.linalg.eigh((matrix + matrix.mT) / 2)
    return (axes * size.clamp_min(0).unsqueeze(-2)) @ axes.mT
