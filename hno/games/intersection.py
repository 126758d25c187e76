"""Two cars reach an uncontrolled intersection at the same time."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from hno.games.affine import ControlAffineGame
from hno.games.base import games
from hno.games.box import Box
from hno.games.plane import Axis, Plane
from hno.games.scene import CAR, CAR_CONTROLS, Road, Scene

ROAD = 4.0
"""Width of the roads in pictures, m."""


@final
@games.register("intersection")
class Intersection(ControlAffineGame):
    """Cars (d, v) on crossing roads, d the distance driven; control is the acceleration, m/s^2.

    Player i occupies the intersection while d_i is in [near - growth theta_i, far]: the larger its type, the earlier it
    claims it. A collision is both players inside their own interval at once.

    Args:
        near: where the interval begins at theta = 0, m.
        far: where it ends, m.
        growth: by how much the interval begins earlier per unit of the type, m.
        speed: nominal speed, m/s.
        horizon: length of the game, s.
    """

    state_names, state_units = ("d", "v"), ("m", "m/s")
    plane = Plane(Axis("d_1", 20, 50), Axis("d_2", 20, 50))
    positive = ("growth", "speed")
    distance_constraints = False
    potential = True
    cells = 20
    """Lattice cells of the sensors along each road."""
    cell = 0.75
    """Their edge, m."""
    first_cell = 27.5
    """Where the first one begins, m."""

    def __init__(
        self, near: float = 35.0, far: float = 38.75, growth: float = 0.75, speed: float = 18.0, horizon: float = 3.0
    ) -> None:
        super().__init__()
        self.near, self.far, self.growth, self.speed, self.horizon = near, far, growth, speed, horizon
        self.state_box = Box([[15, 15]] * 2, [[105, 32]] * 2)
        self.initial_box = Box([[15, 18]] * 2, [[20, 25]] * 2)
        self.control_box = Box([-5], [10])
        self.type_box = Box([1, 1], [5, 5])
        self.register_buffer("input_matrix", torch.tensor([[0.0], [1.0]]))
        self.register_buffer("effort_weight", torch.ones(1))

    def drift(self, x: Tensor) -> Tensor:
        """Motion at constant speed, (B, 2, 2)."""
        return torch.stack([x[..., 1], torch.zeros_like(x[..., 1])], -1)

    def terminal_value(self, x: Tensor) -> Tensor:
        """Drive at nominal speed, (B, 2)."""
        return 1e-6 * x[..., 0] - (x[..., 1] - self.speed).square()

    def positions(self, x: Tensor) -> Tensor:
        """Along x and along y, the intersection around the origin, m, (B, 2, 2)."""
        driven = x[..., 0] - (self.near + self.far) / 2
        return torch.diag_embed(driven)

    def scene(self) -> Scene:
        """Two cars on crossing roads of one lane each."""
        roads = Road(0, (-ROAD / 2, ROAD / 2)), Road(1, (-ROAD / 2, ROAD / 2))
        note = "Bodies of 4.5 m by 1.8 m and roads 4 m wide are drawn for the eye; intervals of the roads decide."
        players = ("car 1, along x", "car 2, along y")
        return Scene((CAR, CAR), roads, CAR_CONTROLS[1:], players, note)

    def constraint(self, x: Tensor, theta: Tensor) -> Tensor:
        """How far both players are inside their intervals, m, (B, 2, 1)."""
        inside = torch.minimum(*self._past_ends(x, theta))
        return inside.amin(-1)[..., None, None].expand(*inside.shape, 1)

    def penalty(self, x: Tensor, theta: Tensor) -> Tensor:
        """Both players' sigmoids of both ends of their intervals, multiplied, 1/s, (B, 2)."""
        begin, end = (torch.sigmoid(self.penalty_slope * past) for past in self._past_ends(x, theta))
        return self.penalty_height * (begin * end).prod(-1, keepdim=True).expand_as(theta)

    def sensors(self, theta: Tensor) -> Tensor:
        """Share of each lattice cell, the own way by the other's, that lies inside both intervals, (B, 2, 400)."""
        first = ((self.near - self.growth * theta - self.first_cell) / self.cell).unsqueeze(-1)
        cells = torch.arange(self.cells, dtype=theta.dtype, device=theta.device)
        last = (self.far - self.first_cell) / self.cell
        covered = ((cells + 1).clamp(max=last) - cells.maximum(first)).clamp(0, 1)
        return (covered.unsqueeze(-1) * covered.flip(-2).unsqueeze(-2)).flatten(-2)

    def _past_ends(self, x: Tensor, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Distances past the beginning and before the end of the own interval, m, each (B, 2)."""
        return x[..., 0] - self.near + self.growth * theta, self.far - x[..., 0]
