"""Games whose constraint is a distance that depends on the players' types."""

from __future__ import annotations

import abc

import torch
from torch import Tensor

from hno.games.base import ControlAffineGame
from hno.games.kinematics import separation


class CollisionAvoidance(ControlAffineGame):
    """Players keep a distance of 0.1 sum_j theta_j + 0.05 min_j theta_j + radius (paper, sec. IV).

    The radius is the same for all players, and the violation set is an interval of distances, so the sensors are its
    indicator along the distance axis. A subclass sets the attributes.
    """

    radius: float
    """Collision radius at theta = 0, m."""
    first_sensor: float
    """Distance of the first sensor, m."""
    sensor_count: int
    """Number of sensors."""
    sensor_spacing: float = 0.05
    """Distance between sensors, m."""

    @abc.abstractmethod
    def positions(self, x: Tensor) -> Tensor:
        """Where the players are in one common frame, m, (B, P, n) -> (B, P, 2 or 3)."""

    def collision_radius(self, theta: Tensor) -> Tensor:
        """The distance that must be kept, m, (B, P) -> (B, P)."""
        radius = 0.1 * theta.sum(-1, keepdim=True) + 0.05 * theta.amin(-1, keepdim=True) + self.radius
        return radius.expand_as(theta)

    def constraint(self, x: Tensor, theta: Tensor) -> Tensor:
        """Collision radius minus distance, m, (B, P)."""
        return self.collision_radius(theta) - separation(self.positions(x))

    def sensors(self, theta: Tensor) -> Tensor:
        """Indicator of the violation set along the distance axis, (B, P, S).

        Radius and sensors are compared in sensor spacings with a tolerance of a thousandth, so that float rounding does
        not decide about a radius that falls on a sensor.
        """
        steps = (self.collision_radius(theta).unsqueeze(-1) - self.first_sensor) / self.sensor_spacing
        return (torch.arange(self.sensor_count, device=theta.device) < steps - 1e-3).to(theta.dtype)
