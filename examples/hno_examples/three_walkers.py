"""Three players who keep distance pairwise: every player has one constraint for each of the other two."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from hno.games import Box, CollisionAvoidance


@final
class ThreeWalkers(CollisionAvoidance):
    """Points (px, py) in one frame that choose their velocity, m/s; all make for the same gate.

    `CollisionAvoidance` gives the constraints, (B, 3, 2), for any number of players.

    Args:
        gate: distance of the gate, m.
        radius: distance that two of them keep at theta = 0, m.
        horizon: length of the game, s.
    """

    roles = (0, 0, 0)
    positive = ("gate",)

    def __init__(self, gate: float = 4.0, radius: float = 0.2, horizon: float = 2.0) -> None:
        super().__init__()
        self.gate, self.radius, self.horizon = gate, radius, horizon
        self.first_sensor, self.sensor_count = radius, 30
        self.state_box = Box([[-1, -4]] * 3, [[6, 4]] * 3)
        self.initial_box = Box([[0, -3]] * 3, [[2, 3]] * 3)
        self.control_box = Box([-4, -4], [4, 4])
        self.type_box = Box([0] * 3, [2] * 3)
        self.register_buffer("input_matrix", torch.eye(2))
        self.register_buffer("effort_weight", torch.ones(2))

    def drift(self, x: Tensor) -> Tensor:
        """Nobody moves by itself, (B, 3, 2)."""
        return torch.zeros_like(x)

    def positions(self, x: Tensor) -> Tensor:
        """The states themselves, m, (B, 3, 2)."""
        return x

    def terminal_value(self, x: Tensor) -> Tensor:
        """Be near the gate, (B, 3)."""
        return -2 * (x[..., 0] - self.gate).square() - 2 * x[..., 1].square()
