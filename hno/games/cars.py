"""Games of cars that keep their distance (paper, sec. IV)."""

from __future__ import annotations

import torch
from torch import Tensor

from hno.games.box import Box
from hno.games.collision import CollisionAvoidance
from hno.games.kinematics import unicycle_drift


class Cars(CollisionAvoidance):
    """Unicycles (px, py, psi, v) with controls (angular velocity, acceleration); a subclass sets the rest."""

    state_names, state_units = ("px", "py", "psi", "v"), ("m", "m", "rad", "m/s")
    relative_names = ("gap", "offset")

    def __init__(self) -> None:
        super().__init__()
        self.control_box = Box([-1, -5], [1, 10])
        self.type_box = Box([1, 1], [5, 5])
        self.register_buffer("input_matrix", torch.eye(4)[:, 2:])
        self.register_buffer("effort_weight", torch.tensor([100.0, 1.0]))

    def drift(self, x: Tensor) -> Tensor:
        """Motion at zero control, (B, 2, 4)."""
        return unicycle_drift(x)
