"""Games of any number of players outside the package: point masses who meet in one place."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from hno.games import Box, CollisionAvoidance
from hno.games.kinematics import double_integrator_drift


class Merging(CollisionAvoidance):
    """Interchangeable point masses (p, q, p', q') in one frame who all want to move along the line q = 0.

    Args:
        players: how many.
    """

    horizon, label_step = 2.0, 0.1
    radius, first_sensor, sensor_count = 0.2, 0.2, 30

    def __init__(self, players: int = 3) -> None:
        super().__init__()
        self.roles = (0,) * players
        self.state_box = Box([[-4, -3, -2, -4]] * players, [[9, 3, 6, 4]] * players)
        self.initial_box = Box([[-3, -2, 1.8, -0.1]] * players, [[3, 2, 2.2, 0.1]] * players)
        self.control_box = Box([-4, -4], [4, 4])
        self.type_box = Box([0] * players, [2] * players)
        self.register_buffer("input_matrix", torch.eye(4)[:, 2:])
        self.register_buffer("effort_weight", torch.ones(2))

    def drift(self, x: Tensor) -> Tensor:
        return double_integrator_drift(x)

    def positions(self, x: Tensor) -> Tensor:
        return x[..., :2]

    def terminal_value(self, x: Tensor) -> Tensor:
        return -5 * x[..., 1].square() - (x[..., 2] - 2).square() - x[..., 3].square()


class Crossing(Merging):
    """Point masses who come from directions evenly around one point, each in a frame of its own."""

    def __init__(self, players: int = 3) -> None:
        super().__init__(players)
        self.roles = tuple(range(players))
        self.initial_box = Box([[-2.2, -0.2, 1.8, -0.1]] * players, [[-1.8, 0.2, 2.2, 0.1]] * players)
        turn = 2 * math.pi * torch.arange(players) / players
        self.register_buffer("along", torch.stack([turn.cos(), turn.sin()], -1))
        self.register_buffer("across", torch.stack([-turn.sin(), turn.cos()], -1))

    def positions(self, x: Tensor) -> Tensor:
        return x[..., :1] * self.along + x[..., 1:2] * self.across


class Nearest(Crossing):
    """The same with the nearest neighbour alone in one constraint, which has kinks: that makes no potential."""

    potential = False

    def constraint(self, x: Tensor, theta: Tensor) -> Tensor:
        return super().constraint(x, theta).amax(-1, keepdim=True)
