"""Games whose constraints are distances that depend on the players' types."""

from __future__ import annotations

import abc
from typing import ClassVar

import torch
from torch import Tensor

from hno.games.affine import ControlAffineGame
from hno.games.kinematics import distances


class CollisionAvoidance(ControlAffineGame):
    """Every two players i, j keep a distance of 0.1 (theta_i + theta_j) + 0.05 min(theta_i, theta_j) + radius.

    This is the radius of the paper (sec. IV) for two or more players. The violation set of a pair is an interval of
    distances, so the sensors are its indicator along the distance axis. A subclass sets the attributes.
    """

    positive: ClassVar[tuple[str, ...]] = ("radius", "sensor_spacing", "sensor_count")
    potential = True
    radius: float
    """Collision radius at theta = 0, m."""
    first_sensor: float
    """Distance of the first sensor, m."""
    sensor_count: int
    """Number of sensors."""
    sensor_spacing: float = 0.05
    """Distance between sensors, m."""

    def __init_subclass__(cls, **options: object) -> None:
        """Refuse games of one player, which have nobody to keep distance from."""
        super().__init_subclass__(**options)
        if len(cls.roles) < 2:
            raise TypeError(
                f"{cls.__name__} has one player, and CollisionAvoidance is for two or more: derive it from "
                "ControlAffineGame and state its constraint."
            )

    @abc.abstractmethod
    def positions(self, x: Tensor) -> Tensor:
        """Where the players are in one common frame, m, (B, P, n) -> (B, P, 2 or 3)."""

    def collision_radius(self, theta: Tensor) -> Tensor:
        """Distances that each player must keep from the others, m, the next one first, (B, P) -> (B, P, P - 1)."""
        others = torch.stack([theta.roll(-shift, -1) for shift in range(1, self.players)], -1)
        own = theta.unsqueeze(-1)
        return 0.1 * (own + others) + 0.05 * torch.minimum(own, others) + self.radius

    def constraint(self, x: Tensor, theta: Tensor) -> Tensor:
        """Collision radius minus distance for each other player, m, (B, P, P - 1).

        A game with further constraints concatenates them along the last axis.
        """
        return self.collision_radius(theta) - distances(self.positions(x))

    def sensors(self, theta: Tensor) -> Tensor:
        """Indicators of the violation sets along the distance axis, the largest first, (B, P, (P - 1) S).

        Radius and sensors are compared in sensor spacings with a tolerance of a thousandth, so that float rounding does
        not decide about a radius that falls on a sensor.
        """
        radius = self.collision_radius(theta).sort(descending=True).values
        steps = (radius.unsqueeze(-1) - self.first_sensor) / self.sensor_spacing
        inside = torch.arange(self.sensor_count, device=theta.device) < steps - 1e-3
        return inside.flatten(-2).to(theta.dtype)
