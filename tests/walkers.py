"""A small game outside the package: two pedestrians who meet head-on."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from hno.games import Box, ControlAffineGame
from hno.games.kinematics import distances


@final
class Walkers(ControlAffineGame):
    """Points (px, py) that choose their velocity; each walks along x in its own frame, towards the other.

    Args:
        width: distance between the origins of the two players' frames, m.
        radius: distance that both keep at theta = 0, m.
    """

    horizon = 1.0

    def __init__(self, width: float = 4.0, radius: float = 0.2) -> None:
        super().__init__()
        self.width, self.radius = width, radius
        self.state_box = Box([[-1, -2]] * 2, [[5, 2]] * 2)
        self.initial_box = Box([[0, -0.3]] * 2, [[0.5, 0.3]] * 2)
        self.control_box = Box([-6, -6], [6, 6])
        self.type_box = Box([0, 0], [4, 4])
        self.register_buffer("input_matrix", torch.eye(2))
        self.register_buffer("effort_weight", torch.ones(2))

    def drift(self, x: Tensor) -> Tensor:
        return torch.zeros_like(x)

    def positions(self, x: Tensor) -> Tensor:
        return torch.stack([x[..., 0, :], x.new_tensor([self.width, 0.0]) - x[..., 1, :]], -2)

    def terminal_value(self, x: Tensor) -> Tensor:
        return -10 * (x[..., 0] - self.width).square() - x[..., 1].square()

    def constraint(self, x: Tensor, theta: Tensor) -> Tensor:
        return self.radius + 0.1 * theta.sum(-1)[..., None, None] - distances(self.positions(x))

    def sensors(self, theta: Tensor) -> Tensor:
        return torch.stack([theta, theta.flip(-1)], -1) / 4
