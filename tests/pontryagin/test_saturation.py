"""Kinks of saturated controls: their times, and the accuracy that nodes on them give back."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from hno.games import Box, ControlAffineGame
from hno.pontryagin import Solver, solve
from hno.pontryagin.saturation import saturation_times
from hno.pontryagin.solve import solve_on_mesh
from hno.types import Status

APART, CROSSING = (0.23, 0.71), (0.515, 0.535)
"""Times of the two kinks: far apart, and between one mesh node and the next centre."""
COARSE = Solver(extra_nodes=0)
WITHOUT_KINKS = COARSE._replace(reintegration=1e9)
"""A tolerance that every trajectory meets: no mesh is changed."""


class Brake(ControlAffineGame):
    """One player, x'' = u with |u| <= 1, effort u^2 and a terminal value a x + d x'.

    The costate of x' is a (1 - t) + d, so that u is half of that, clamped: a and d are chosen such that it leaves 1 at
    one time and arrives at -1 at the other.

    Args:
        leaves: s.
        arrives: s.
    """

    horizon = 1.0
    roles = (0,)

    def __init__(self, leaves: float, arrives: float) -> None:
        super().__init__()
        self.leaves, self.arrives, self.slope = leaves, arrives, 2 / (arrives - leaves)
        self.state_box = Box([[-2, -2]], [[2, 2]])
        self.initial_box = Box([[-1, -1]], [[1, 1]])
        self.control_box = Box([-1], [1])
        self.type_box = Box([0], [1])
        self.register_buffer("input_matrix", torch.tensor([[0.0], [1.0]]))
        self.register_buffer("effort_weight", torch.ones(1))

    def drift(self, x: Tensor) -> Tensor:
        return torch.stack([x[..., 1], torch.zeros_like(x[..., 1])], -1)

    def terminal_value(self, x: Tensor) -> Tensor:
        return 2 * self.slope * x[..., 0] + 2 * (1 - self.slope * (1 - self.leaves)) * x[..., 1]

    def constraint(self, x: Tensor, theta: Tensor) -> Tensor:
        return torch.full_like(x[..., :1], -20.0)

    def sensors(self, theta: Tensor) -> Tensor:
        return theta.unsqueeze(-1)

    def positions(self, x: Tensor) -> Tensor:
        return x

    def exact(self, x0: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """States (B, K, 1, 2) and controls (K,), with two ramps for the clamp."""
        place, speed = x0[:, 0].unsqueeze(1).unbind(-1)
        ramps = (t - self.leaves).clamp_min(0), (t - self.arrives).clamp_min(0)
        u, *integrals = (
            self.slope / scale * (ramps[1] ** power - ramps[0] ** power) for power, scale in enumerate((1, 2, 6), 1)
        )
        x = torch.stack([place + speed * t + t**2 / 2 + integrals[1], speed + t + integrals[0]], -1)
        return x.unsqueeze(-2), 1 + u


def setting(kinks: tuple[float, float]) -> tuple[Brake, Tensor, Tensor]:
    game = Brake(*kinks).double()
    return game, game.initial_box.sample(3, torch.Generator().manual_seed(0)), torch.zeros(3, 1, dtype=torch.float64)


def largest_errors(game: Brake, x0: Tensor, theta: Tensor, settings: Solver) -> tuple[float, float]:
    found = solve(game, x0, theta, settings)
    assert found.status.tolist() == [Status.CONVERGED] * 3
    x, u = game.exact(x0, found.t)
    return float((found.x - x).abs().max()), float((found.u[..., 0, 0] - u).abs().max())


@pytest.mark.parametrize("kinks", [APART, CROSSING], ids=["apart", "crossing"])
def test_kinks_are_found_where_they_are(kinks):
    game, x0, theta = setting(kinks)
    at = solve_on_mesh(game, x0, theta, WITHOUT_KINKS).at
    times = saturation_times(game, at).sort(dim=-1).values
    torch.testing.assert_close(times, torch.tensor([kinks] * 3, dtype=torch.float64), rtol=0, atol=1e-8)


def test_free_controls_have_no_kinks():
    game, x0, theta = setting((-0.5, 1.5))
    at = solve_on_mesh(game, x0, theta, COARSE).at
    assert saturation_times(game, at).shape == (3, 0)


def test_rows_with_fewer_kinks_are_filled_up_with_the_horizon():
    game, x0, theta = setting(APART)
    at = solve_on_mesh(game, x0, theta, WITHOUT_KINKS).at
    at.z[1, :, 2:] *= 1e-3
    times = saturation_times(game, at).sort(dim=-1).values
    expected = torch.tensor([APART, (1.0, 1.0), APART], dtype=torch.float64)
    torch.testing.assert_close(times, expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize("kinks", [APART, CROSSING], ids=["apart", "crossing"])
def test_a_saturated_optimum_is_the_exact_one_once_nodes_are_on_its_kinks(kinks):
    setup = setting(kinks)
    with_nodes, without = largest_errors(*setup, COARSE), largest_errors(*setup, WITHOUT_KINKS)
    assert max(with_nodes) < 1e-8
    assert without[0] > 1e-4
