"""Batched block elimination of the linearised collocation equations."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Elimination(NamedTuple):
    """Block elimination of left_k dz_k + right_k dz_{k+1} = -defect_k with dl_K = slope dx_K - terminal defect.

    Backward, the step of the costates is kept as an affine function of the step of the states, dl_k = S_k dx_k + s_k;
    forward, the states follow. Initial states are fixed, so dx_0 = 0.
    """

    factors: Tensor
    """LU factors of each interval's matrix for (dl_k, dx_{k+1}), (B, K - 1, D, D)."""
    pivots: Tensor
    """Pivots of the factors, (B, K - 1, D)."""
    slopes: Tensor
    """(dl_k, dx_{k+1}) per dx_k, (B, K - 1, D, D / 2)."""
    ahead: Tensor
    """Derivative of each defect in the next costates, (B, K - 1, D, D / 2)."""
    end: Tensor
    """S_K, (B, D / 2, D / 2)."""

    def rows(self, index: Tensor) -> Elimination:
        """The systems at `index`."""
        return Elimination(*(part[index] for part in self))

    def solve(self, defect: Tensor, terminal_defect: Tensor) -> Tensor:
        """Step that removes the defects (B, K - 1, D) and (B, D / 2) to first order, (B, K, D)."""
        half = self.end.shape[-1]
        defect, shift = defect.to(self.end.dtype), -terminal_defect.to(self.end.dtype)
        offsets = []
        for k in reversed(range(defect.shape[1])):
            known = defect[:, k] + _apply(self.ahead[:, k], shift)
            solved = torch.linalg.lu_solve(self.factors[:, k], self.pivots[:, k], known.unsqueeze(-1))
            offsets.append(-solved.squeeze(-1))
            shift = offsets[-1][:, :half]
        end, state, step = -terminal_defect.to(self.end.dtype), torch.zeros_like(shift), []
        for k, offset in enumerate(reversed(offsets)):
            costate, following = (_apply(self.slopes[:, k], state) + offset).split(half, -1)
            step.append(torch.cat([state, costate], -1))
            state = following
        step.append(torch.cat([state, _apply(self.end, state) + end], -1))
        return torch.stack(step, 1)


def eliminate(left: Tensor, right: Tensor, end: Tensor) -> Elimination:
    """Factorise, from the last interval to the first; arguments as in `Elimination`."""
    half, slope = end.shape[-1], end
    factors, pivots, slopes = [], [], []
    for k in reversed(range(left.shape[1])):
        matrix = torch.cat([left[:, k, :, half:], right[:, k, :, :half] + right[:, k, :, half:] @ slope], -1)
        factor, pivot, _ = torch.linalg.lu_factor_ex(matrix)
        slopes.append(-torch.linalg.lu_solve(factor, pivot, left[:, k, :, :half]))
        factors.append(factor)
        pivots.append(pivot)
        slope = slopes[-1][:, :half]
    stacked = [torch.stack(part[::-1], 1) for part in (factors, pivots, slopes)]
    return Elimination(stacked[0], stacked[1], stacked[2], right[..., half:].contiguous(), end)


def _apply(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)
