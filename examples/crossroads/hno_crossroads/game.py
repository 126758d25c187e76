"""Four cars reach an uncontrolled crossing, one on each arm."""

from __future__ import annotations

import math
from typing import final

import torch
from torch import Tensor

from hno.games import Box, CollisionAvoidance


@final
class Crossroads(CollisionAvoidance):
    """Cars (s, v) that drive straight on in their lanes, s from the middle, m; controls are accelerations, m/s^2.

    Each keeps its distance from the three others, (B, 4, 3). Those who come towards each other have lanes of their own.

    Args:
        pace: preferred speed, m/s.
        lane: distance of a lane's middle from the middle of its road, m.
        radius: distance that two cars keep at theta = 0, m.
        horizon: length of the game, s.
    """

    state_names, state_units = ("s", "v"), ("m", "m/s")
    roles = (0, 1, 2, 3)
    positive = ("pace", "lane")

    def __init__(self, pace: float = 8.0, lane: float = 1.75, radius: float = 2.0, horizon: float = 3.0) -> None:
        super().__init__()
        self.pace, self.lane, self.radius, self.horizon = pace, lane, radius, horizon
        self.first_sensor, self.sensor_count = radius, 30
        self.state_box = Box([[-22, 0]] * 4, [[16, 14]] * 4)
        self.initial_box = Box([[-20, 7]] * 4, [[-14, 9]] * 4)
        self.control_box = Box([-6], [4])
        self.type_box = Box([1] * 4, [5] * 4)
        self.register_buffer("input_matrix", torch.tensor([[0.0], [1.0]]))
        self.register_buffer("effort_weight", torch.full((1,), 0.1))
        heading = math.pi / 2 * torch.arange(4)
        self.register_buffer("along", torch.stack([heading.cos(), heading.sin()], -1))
        self.register_buffer("right", torch.stack([heading.sin(), -heading.cos()], -1))

    def drift(self, x: Tensor) -> Tensor:
        """Motion at constant speed, (B, 4, 2)."""
        return torch.stack([x[..., 1], torch.zeros_like(x[..., 1])], -1)

    def positions(self, x: Tensor) -> Tensor:
        """On the right of the own road, m, (B, 4, 2)."""
        return x[..., :1] * self.along + self.lane * self.right

    def terminal_value(self, x: Tensor) -> Tensor:
        """Be through, at the preferred speed, (B, 4)."""
        return 0.5 * x[..., 0] - (x[..., 1] - self.pace).square()
