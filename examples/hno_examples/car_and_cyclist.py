"""Players who differ in everything: a car and a cyclist cross, with their own limits, efforts and goals.

What differs has one row per player; `roles` says that the players are not interchangeable.
"""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from hno.games import Box, CollisionAvoidance
from hno.games.kinematics import double_integrator_drift


@final
class CarAndCyclist(CollisionAvoidance):
    """Points (px, py, vx, vy) in one frame; the car drives along x, the cyclist along y; controls are accelerations.

    Args:
        speeds: preferred speeds of the car and of the cyclist, m/s.
        radius: collision radius at theta = 0, m.
        horizon: length of the game, s.
    """

    roles = (0, 1)
    goals: Tensor

    def __init__(self, speeds: tuple[float, float] = (10.0, 5.0), radius: float = 1.0, horizon: float = 3.0) -> None:
        super().__init__()
        self.radius, self.horizon = radius, horizon
        self.first_sensor, self.sensor_count = radius, 30
        self.state_box = Box([[-20, -3, 0, -3], [-3, -10, -2, 0]], [[25, 3, 15, 3], [3, 15, 2, 8]])
        self.initial_box = Box([[-16, -0.5, 9, 0], [-0.5, -8, 0, 4]], [[-12, 0.5, 11, 0], [0.5, -6, 0, 6]])
        self.control_box = Box([[-8, -2], [-1, -3]], [[4, 2], [1, 1.5]])
        self.type_box = Box([1, 1], [5, 5])
        self.register_buffer("input_matrix", torch.eye(4)[:, 2:])
        self.register_buffer("effort_weight", torch.tensor([[1.0, 4.0], [4.0, 2.0]]))
        self.register_buffer("goals", torch.tensor([[speeds[0], 0.0], [0.0, speeds[1]]]))

    def drift(self, x: Tensor) -> Tensor:
        """Motion without acceleration, (B, 2, 4)."""
        return double_integrator_drift(x)

    def positions(self, x: Tensor) -> Tensor:
        """(px, py) in the common frame, m, (B, 2, 2)."""
        return x[..., :2]

    def terminal_value(self, x: Tensor) -> Tensor:
        """Each back on its own line, at its own velocity, (B, 2)."""
        off_line = torch.stack([x[..., 0, 1], x[..., 1, 0]], -1)
        return -off_line.square() - (x[..., 2:] - self.goals).square().sum(-1)
