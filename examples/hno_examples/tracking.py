"""A game with a running cost of states: two riders meet head-on, and each would rather stay on its line.

The term that tracks the line is `state_cost`; the penalty of the constraint is added to it by the game itself.
"""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from hno.games import Box, CollisionAvoidance


@final
class Tracking(CollisionAvoidance):
    """Points (along, across) that move along at constant speed; the control is the lateral velocity, m/s.

    The terminal cost is that of tracking the line for ever. Without a second player V_i = -sqrt(stiffness) across^2.

    Args:
        stiffness: weight of the squared distance from the line, 1/(m^2 s).
        length: distance between the origins of the two players' frames, m.
        speed: speed along the line, m/s.
        radius: collision radius at theta = 0, m.
        horizon: length of the game, s.
    """

    positive = ("stiffness", "length", "speed")

    def __init__(
        self,
        stiffness: float = 4.0,
        length: float = 16.0,
        speed: float = 4.0,
        radius: float = 0.3,
        horizon: float = 3.0,
    ) -> None:
        super().__init__()
        self.stiffness, self.length, self.speed = stiffness, length, speed
        self.radius, self.horizon = radius, horizon
        self.first_sensor, self.sensor_count = radius, 30
        self.state_box = Box([[0, -2]] * 2, [[16, 2]] * 2)
        self.initial_box = Box([[0, -0.5]] * 2, [[1, 0.5]] * 2)
        self.control_box = Box([-3], [3])
        self.type_box = Box([1, 1], [5, 5])
        self.register_buffer("input_matrix", torch.tensor([[0.0], [1.0]]))
        self.register_buffer("effort_weight", torch.ones(1))

    def drift(self, x: Tensor) -> Tensor:
        """Motion without steering, (B, 2, 2)."""
        along = torch.full_like(x[..., 0], self.speed)
        return torch.stack([along, torch.zeros_like(along)], -1)

    def state_cost(self, x: Tensor, theta: Tensor) -> Tensor:
        """Squared distance from the line, weighted, 1/s, (B, 2)."""
        return self.stiffness * x[..., 1].square()

    def terminal_value(self, x: Tensor) -> Tensor:
        """Minus the cost of returning to the line after the game, (B, 2)."""
        return -(self.stiffness**0.5) * x[..., 1].square()

    def positions(self, x: Tensor) -> Tensor:
        """The second player rides the other way, m, (B, 2, 2)."""
        along, across = x[..., 0], x[..., 1]
        return torch.stack([torch.stack([along[..., 0], self.length - along[..., 1]], -1), across], -1)
