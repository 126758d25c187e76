"""Geometry and vehicle models that several games share."""

from __future__ import annotations

import math

import torch
from torch import Tensor

GRAVITY = 9.81
"""Standard gravity as the paper rounds it, m/s^2."""
DEGREE = math.pi / 180
"""One degree, rad."""


def unicycle_drift(x: Tensor) -> Tensor:
    """Uncontrolled motion of a unicycle (px, py, psi, v), shape (..., 4)."""
    _, _, heading, speed = x.unbind(-1)
    still = torch.zeros_like(speed)
    return torch.stack([speed * heading.cos(), speed * heading.sin(), still, still], -1)


def double_integrator_drift(x: Tensor) -> Tensor:
    """Uncontrolled motion of positions and velocities (p, v), shape (..., 2 d)."""
    velocity = x.unflatten(-1, (2, -1))[..., 1, :]
    return torch.cat([velocity, torch.zeros_like(velocity)], -1)


def separation(positions: Tensor, softness: float = 1e-6) -> Tensor:
    """Distance of each player to its nearest other player, m, inf for one alone, (..., P, d) -> (..., P).

    Args:
        positions: points in one common frame, m.
        softness: rounds the tip of the cone, m, so that every derivative is finite where players touch.
    """
    nearest = torch.full_like(positions[..., 0], torch.inf)
    for shift in range(1, positions.shape[-2]):
        nearest = torch.minimum(nearest, (positions - positions.roll(shift, -2)).square().sum(-1))
    return (nearest + softness**2).sqrt()
