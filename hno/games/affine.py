"""Games whose dynamics are affine in a function of each control, with their best responses in closed form."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from hno.games.base import Game


class ControlAffineGame(Game):
    """A game whose dynamics are drift(x) + G(x) w(u) with effort sum_k r_k w_k^2, w an increasing map of each control.

    The Hamiltonian is then a concave parabola in every w_k, so its maximiser on a box is the clamped vertex, exactly:
    w = clamp(G' lambda_ii / 2r).
    """

    INSTEAD: ClassVar[Mapping[str, str]] = {
        "dynamics": "drift, control_matrix or affine_input",
        "effort": "effort_weight or affine_input",
        "best_response": "control_matrix, effort_weight, affine_input or control_box",
    }

    input_matrix: Tensor
    """G where it is constant, shape (n, m), or (P, n, m) where players differ, a buffer."""
    effort_weight: Tensor
    """r, shape (m,), or (P, m) where players differ, a buffer."""

    @abc.abstractmethod
    def drift(self, x: Tensor) -> Tensor:
        """Dynamics at w = 0, (B, P, n) -> (B, P, n)."""

    def control_matrix(self, x: Tensor) -> Tensor:
        """G, shape (n, m), (P, n, m) or (B, P, n, m), of states (B, P, n): by default `input_matrix`."""
        return self.input_matrix

    def affine_input(self, u: Tensor) -> Tensor:
        """w(u), the input in which the dynamics are affine, (B, P, m) -> (B, P, m)."""
        return u

    def control_of(self, w: Tensor) -> Tensor:
        """Inverse of `affine_input`."""
        return w

    def dynamics(self, x: Tensor, u: Tensor) -> Tensor:
        """Time derivative of the state, (B, P, n)."""
        return self.drift(x) + _times(self.affine_input(u), self.control_matrix(x).mT)

    def effort(self, u: Tensor) -> Tensor:
        """Weighted squares of the affine input, 1/s, (B, P)."""
        return torch.linalg.vecdot(self.affine_input(u).square(), self.effort_weight)

    def best_response(self, x: Tensor, own_costate: Tensor) -> Tensor:
        """The clamped vertex of each player's Hamiltonian, (B, P, m)."""
        vertex = _times(own_costate, self.control_matrix(x)) / (2 * self.effort_weight)
        return self.control_of(vertex.clamp(*map(self.affine_input, (self.control_box.lo, self.control_box.hi))))


def _times(rows: Tensor, matrix: Tensor) -> Tensor:
    """Rows (B, P, a) times one matrix (a, b), or each times its own, (B, P, a, b) or (P, a, b)."""
    return rows @ matrix if matrix.dim() == 2 else (rows.unsqueeze(-2) @ matrix).squeeze(-2)
