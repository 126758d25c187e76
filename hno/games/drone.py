"""Two drones cross each other's path (paper, case 3)."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from hno.games.base import games
from hno.games.box import Box
from hno.games.collision import CollisionAvoidance
from hno.games.kinematics import GRAVITY, double_integrator_drift
from hno.games.plane import Axis, Plane
from hno.games.scene import Scene


@final
@games.register("drone")
class Drone(CollisionAvoidance):
    """Points (px, py, pz, vx, vy, vz); controls (roll, pitch, thrust) in the paper's words, rad, rad and m/s^2.

    The dynamics are affine in (tan roll, tan pitch, thrust - g).

    Args:
        width: distance between the origins of the two players' frames along x and along y, m.
        radius: collision radius at theta = 0, m.
        horizon: length of the game, s.
    """

    state_names, state_units = ("px", "py", "pz", "vx", "vy", "vz"), ("m",) * 3 + ("m/s",) * 3
    relative_names = ("gap_x", "gap_y", "gap_z")
    plane = Plane(Axis("gap_x", -5, 5), Axis("gap_y", -5, 5))
    positive = ("width",)

    def __init__(self, width: float = 5.0, radius: float = 0.5, horizon: float = 4.0) -> None:
        super().__init__()
        self.width, self.radius, self.horizon = width, radius, horizon
        self.first_sensor, self.sensor_count = radius, 30
        self.state_box = Box([[0, 0, -2.2, 0.3, 0.3, -2]] * 2, [[15.5, 15.5, 2.5, 4.5, 4.5, 2.2]] * 2)
        self.initial_box = Box([[0, 0, -0.1, 2, 2, 0]] * 2, [[1, 1, 0.1, 4, 4, 0.1]] * 2)
        self.control_box = Box([-0.05, -0.05, GRAVITY - 2], [0.05, 0.05, GRAVITY + 2])
        self.type_box = Box([1, 1], [5, 5])
        acceleration = torch.diag(torch.tensor([GRAVITY, -GRAVITY, 1.0]))
        self.register_buffer("input_matrix", torch.cat([torch.zeros(3, 3), acceleration]))
        self.register_buffer("effort_weight", torch.tensor([100.0, 100.0, 1.0]))

    def affine_input(self, u: Tensor) -> Tensor:
        """(tan roll, tan pitch, thrust - g), (B, 2, 3)."""
        return torch.cat([u[..., :2].tan(), u[..., 2:] - GRAVITY], -1)

    def control_of(self, w: Tensor) -> Tensor:
        """(roll, pitch, thrust), (B, 2, 3)."""
        return torch.cat([w[..., :2].atan(), w[..., 2:] + GRAVITY], -1)

    def drift(self, x: Tensor) -> Tensor:
        """Motion at hover thrust, (B, 2, 6)."""
        return double_integrator_drift(x)

    def positions(self, x: Tensor) -> Tensor:
        """Player 2's px and py run from the opposite corner, m, (B, 2, 3)."""
        ahead, behind = x[..., 0, :3], x[..., 1, :3]
        return torch.stack([ahead, torch.cat([self.width - behind[..., :2], behind[..., 2:]], -1)], -2)

    def scene(self) -> Scene:
        """Two drones, points in space."""
        players = ("drone 1, from the origin", "drone 2, from the opposite corner")
        return Scene((), (), ("roll [rad]", "pitch [rad]", "thrust [m/s²]"), players)

    def terminal_value(self, x: Tensor) -> Tensor:
        """Hover at height 0, (B, 2)."""
        forward = x[..., :2].sum(-1)
        return 1e-6 * forward - x[..., 2:].square().sum(-1)
