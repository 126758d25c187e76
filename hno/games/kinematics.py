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


def distances(positions: Tensor, softness: float = 1e-6) -> Tensor:
    """Distances of each player to the others, m, the next player first, (..., P, d) -> (..., P, P - 1).

    Args:
        positions: points in one common frame, m.
        softness: rounds the tip of the cone, m, so that every derivative is finite where players touch.
    """
    if positions.shape[-2] == 1:
        return positions[..., :0]
    gaps = [positions - positions.roll(-shift, -2) for shift in range(1, positions.shape[-2])]
    return (torch.stack(gaps, -2).square().sum(-1) + softness**2).sqrt()


def separation(positions: Tensor) -> Tensor:
    """Distance of each player to its nearest other player, m, inf for one alone, (..., P, d) -> (..., P)."""
    alone = torch.full_like(positions[..., :1], torch.inf)
    return torch.cat([distances(positions), alone], -1).amin(-1)
