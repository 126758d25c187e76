"""Two cars meet head-on on a narrow road (paper, case 1)."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from hno.games.base import games
from hno.games.box import Box
from hno.games.cars import Cars
from hno.games.kinematics import DEGREE
from hno.games.plane import Axis, Plane
from hno.games.scene import CAR, CAR_CONTROLS, Road, Scene


@final
@games.register("narrow_road")
class NarrowRoad(Cars):
    """Unicycles (px, py, psi, v), each driving towards the other; controls (angular velocity, acceleration).

    Args:
        length: distance between the origins of the two players' frames, m.
        lane: lateral position that the terminal cost asks for, m.
        speed: nominal speed, m/s.
        radius: collision radius at theta = 0, m.
        horizon: length of the game, s.
    """

    plane = Plane(Axis("gap", -10, 40), Axis("offset", -4, 4))
    positive = ("length", "speed")

    def __init__(
        self, length: float = 70.0, lane: float = 4.0, speed: float = 18.0, radius: float = 1.25, horizon: float = 3.0
    ) -> None:
        super().__init__()
        self.length, self.lane, self.speed, self.radius, self.horizon = length, lane, speed, radius, horizon
        self.first_sensor, self.sensor_count = radius - 0.25, 50
        self.state_box = Box([[15, 0, -0.2, 18]] * 2, [[95, 8, 0.2, 29]] * 2)
        self.initial_box = Box([[15, 3.25, -DEGREE, 18]] * 2, [[20, 4.75, DEGREE, 25]] * 2)

    def positions(self, x: Tensor) -> Tensor:
        """Player 2's px runs from the other end of the road, m, (B, 2, 2)."""
        along, across = x[..., 0], x[..., 1]
        return torch.stack([torch.stack([along[..., 0], self.length - along[..., 1]], -1), across], -1)

    def scene(self) -> Scene:
        """Two cars on a road as wide as the PDE box."""
        edges = float(self.state_box.lo[0, 1]), float(self.state_box.hi[0, 1])
        note = "Bodies of 4.5 m by 1.8 m and a road as wide as the PDE box are drawn for the eye: the game has neither."
        players = ("car 1, from the left", "car 2, from the right")
        return Scene((CAR, CAR), (Road(0, edges),), CAR_CONTROLS, players, note)

    def terminal_value(self, x: Tensor) -> Tensor:
        """Stay in the lane at nominal speed, (B, 2)."""
        along, across, _, speed = x.unbind(-1)
        return 1e-6 * along - (speed - self.speed).square() - (across - self.lane).square()
