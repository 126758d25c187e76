"""Axis-aligned boxes of states, controls and types."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class Box(nn.Module):
    """The axis-aligned box `lo <= x <= hi`.

    Args:
        lo: lower corner, any shape.
        hi: upper corner, the same shape, nowhere below `lo`.
    """

    lo: Tensor
    hi: Tensor

    def __init__(self, lo: Sequence[object] | Tensor, hi: Sequence[object] | Tensor) -> None:
        super().__init__()
        self.register_buffer("lo", torch.as_tensor(lo, dtype=torch.get_default_dtype()))
        self.register_buffer("hi", torch.as_tensor(hi, dtype=torch.get_default_dtype()))
        if self.lo.shape != self.hi.shape or bool((self.lo > self.hi).any()):
            raise ValueError(f"A box needs lo <= hi of equal shape; got lo {self.lo.tolist()}, hi {self.hi.tolist()}.")

    @property
    def width(self) -> Tensor:
        """Edge lengths."""
        return self.hi - self.lo

    def scale(self, x: Tensor) -> Tensor:
        """Map the box to [-1, 1], shape (..., *box)."""
        return 2 * (x - self.lo) / self.width - 1

    def clamp(self, x: Tensor) -> Tensor:
        """The nearest point of the box."""
        return x.clamp(self.lo, self.hi)

    def contains(self, x: Tensor) -> Tensor:
        """Whether each point lies in the box, shape (...)."""
        inside = (self.lo <= x) & (x <= self.hi)
        return inside.flatten(inside.dim() - self.lo.dim()).all(-1)

    def sample(self, size: int, generator: torch.Generator) -> Tensor:
        """Uniform points, shape (size, *box)."""
        unit = torch.rand((size, *self.lo.shape), generator=generator, dtype=self.lo.dtype, device=generator.device)
        return self.lo + unit.to(self.lo) * self.width

    def widened(self, factor: float) -> Box:
        """The box with `factor` times the width around the same centre."""
        centre, half = (self.lo + self.hi) / 2, factor * self.width / 2
        return Box(centre - half, centre + half)
