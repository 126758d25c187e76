"""A game whose control matrix depends on the state: kinematic bicycles, which turn the faster the faster they go."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from hno.games import Box, CollisionAvoidance
from hno.games.kinematics import unicycle_drift


@final
class Bicycle(CollisionAvoidance):
    """States (px, py, psi, v) of two cars that meet head-on; controls (steering angle, acceleration), rad and m/s^2.

    psi' = v / wheelbase tan(steering angle), so the dynamics are affine in the tangent of the angle, times a matrix
    that depends on v.

    Args:
        wheelbase: distance between the axles, m.
        length: distance between the origins of the two players' frames, m.
        speed: nominal speed, m/s.
        radius: collision radius at theta = 0, m.
        horizon: length of the game, s.
    """

    positive = ("wheelbase", "length", "speed")

    def __init__(
        self,
        wheelbase: float = 2.7,
        length: float = 70.0,
        speed: float = 18.0,
        radius: float = 1.25,
        horizon: float = 3.0,
    ) -> None:
        super().__init__()
        self.wheelbase, self.length, self.speed, self.radius, self.horizon = wheelbase, length, speed, radius, horizon
        self.first_sensor, self.sensor_count = radius, 30
        self.state_box = Box([[15, -4, -0.3, 10]] * 2, [[95, 4, 0.3, 29]] * 2)
        self.initial_box = Box([[15, -0.75, -0.02, 18]] * 2, [[20, 0.75, 0.02, 25]] * 2)
        self.control_box = Box([-0.15, -5], [0.15, 10])
        self.type_box = Box([1, 1], [5, 5])
        self.register_buffer("effort_weight", torch.tensor([4000.0, 1.0]))

    def drift(self, x: Tensor) -> Tensor:
        """Straight on at constant speed, (B, 2, 4)."""
        return unicycle_drift(x)

    def control_matrix(self, x: Tensor) -> Tensor:
        """How the heading and the speed answer to tan(steering angle) and acceleration, (B, 2, 4, 2)."""
        turning = torch.stack([x[..., 3] / self.wheelbase, torch.zeros_like(x[..., 3])], -1)
        accelerating = torch.tensor([0.0, 1.0]).to(x).expand_as(turning)
        nothing = torch.zeros_like(turning)
        return torch.stack([nothing, nothing, turning, accelerating], -2)

    def affine_input(self, u: Tensor) -> Tensor:
        """(tan(steering angle), acceleration), (B, 2, 2)."""
        return torch.cat([u[..., :1].tan(), u[..., 1:]], -1)

    def control_of(self, w: Tensor) -> Tensor:
        """The inverse of `affine_input`, (B, 2, 2)."""
        return torch.cat([w[..., :1].atan(), w[..., 1:]], -1)

    def positions(self, x: Tensor) -> Tensor:
        """The second car comes from the other end of the road, m, (B, 2, 2)."""
        along, across = x[..., 0], x[..., 1]
        return torch.stack([torch.stack([along[..., 0], self.length - along[..., 1]], -1), across], -1)

    def terminal_value(self, x: Tensor) -> Tensor:
        """Be in the middle at nominal speed, (B, 2)."""
        _, across, heading, speed = x.unbind(-1)
        return -(speed - self.speed).square() - across.square() - 100 * heading.square()
