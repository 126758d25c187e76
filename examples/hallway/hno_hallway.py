"""Two people meet in a hallway: a game for hno in its own package.

`pip install ./examples/hallway`, then `python train.py game=hallway`.
"""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from hno.games import Box, CollisionAvoidance
from hno.games.kinematics import double_integrator_drift


@final
class Hallway(CollisionAvoidance):
    """Points (px, py, vx, vy), each walking towards the other; controls are accelerations, m/s^2.

    Args:
        length: distance between the origins of the two frames, m.
        pace: preferred walking speed, m/s.
        radius: collision radius at theta = 0, m.
        horizon: length of the game, s.
    """

    def __init__(self, length: float = 6.0, pace: float = 1.3, radius: float = 0.2, horizon: float = 3.0) -> None:
        super().__init__()
        self.length, self.pace, self.radius, self.horizon = length, pace, radius, horizon
        self.first_sensor, self.sensor_count = radius, 30
        self.state_box = Box([[0, -1.5, 0, -1]] * 2, [[8, 1.5, 2, 1]] * 2)
        self.initial_box = Box([[0, -0.3, 1, 0]] * 2, [[1, 0.3, 1.5, 0]] * 2)
        self.control_box = Box([-2, -2], [2, 2])
        self.type_box = Box([1, 1], [5, 5])
        self.register_buffer("input_matrix", torch.eye(4)[:, 2:])
        self.register_buffer("effort_weight", torch.ones(2))

    def drift(self, x: Tensor) -> Tensor:
        """Motion at zero control, (B, 2, 4)."""
        return double_integrator_drift(x)

    def positions(self, x: Tensor) -> Tensor:
        """The second person walks the other way, m, (B, 2, 2)."""
        along, across = x[..., 0], x[..., 1]
        return torch.stack([torch.stack([along[..., 0], self.length - along[..., 1]], -1), across], -1)

    def terminal_value(self, x: Tensor) -> Tensor:
        """Walk on in the middle at the preferred speed, (B, 2)."""
        _, across, speed, drifting = x.unbind(-1)
        return -(speed - self.pace).square() - across.square() - drifting.square()
