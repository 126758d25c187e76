"""Two cars side by side exchange their lanes (paper, case 2)."""

from __future__ import annotations

from types import MappingProxyType
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
@games.register("lane_change")
class LaneChange(Cars):
    """Unicycles (px, py, psi, v) with different target lanes; controls (angular velocity, acceleration).

    Args:
        lanes: lateral positions that players 1 and 2 aim for, m.
        speed: nominal speed, m/s.
        radius: collision radius at theta = 0, m.
        horizon: length of the game, s.
    """

    roles = (0, 1)
    plane = Plane(Axis("gap", -15, 15), Axis("offset", -4, 6))
    base = MappingProxyType({"px_1": 40.0, "px_2": 40.0})
    positive = ("speed",)
    lanes: Tensor

    def __init__(
        self,
        lanes: tuple[float, float] = (6.0, 2.0),
        speed: float = 18.0,
        radius: float = 2.25,
        horizon: float = 4.0,
    ) -> None:
        super().__init__()
        self.speed, self.radius, self.horizon = speed, radius, horizon
        self.first_sensor, self.sensor_count = radius - 0.25, 40
        self.register_buffer("lanes", torch.tensor(lanes))
        self.state_box = Box([[0, 0, -0.17, 17], [0, 2, -0.15, 17]], [[90, 6, 0.15, 26], [90, 8, 0.17, 26]])
        self.initial_box = Box(
            [[0, 1.25, -DEGREE, 18], [0, 5.25, -DEGREE, 18]], [[3, 2.75, DEGREE, 25], [3, 6.75, DEGREE, 25]]
        )

    def positions(self, x: Tensor) -> Tensor:
        """(px, py) of both players in the same frame, m, (B, 2, 2)."""
        return x[..., :2]

    def scene(self) -> Scene:
        """Two cars on a road of two lanes, whose middles are the lateral positions that they aim for."""
        low, high = sorted(map(float, self.lanes))
        half = (high - low) / 2
        note = "Bodies of 4.5 m by 1.8 m and the edges of the lanes are drawn for the eye; the game knows neither."
        players = tuple(f"car {i + 1}, to the lane at {float(lane):g} m" for i, lane in enumerate(self.lanes))
        road = Road(0, (low - half, high + half), ((low + high) / 2,))
        return Scene((CAR, CAR), (road,), CAR_CONTROLS, players, note)

    def terminal_value(self, x: Tensor) -> Tensor:
        """Reach the other lane, straight and at nominal speed, (B, 2)."""
        along, across, heading, speed = x.unbind(-1)
        miss = (across - self.lanes).square() + (speed - self.speed).square() + 100 * heading.square()
        return 1e-6 * along - miss
