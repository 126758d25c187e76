"""Runge-Kutta steps at held control."""

from __future__ import annotations

from torch import Tensor

from hno.games import Game


def runge_kutta(game: Game, x: Tensor, u: Tensor, dt: float | Tensor) -> Tensor:
    """One classical Runge-Kutta step of the dynamics at held control.

    Args:
        game: the game.
        x: states, (B, P, n).
        u: controls, (B, P, m).
        dt: step, s; a tensor must broadcast against x.

    Returns:
        States after the step, (B, P, n).
    """
    first = game.dynamics(x, u)
    second = game.dynamics(x + dt / 2 * first, u)
    third = game.dynamics(x + dt / 2 * second, u)
    fourth = game.dynamics(x + dt * third, u)
    return x + dt / 6 * (first + 2 * second + 2 * third + fourth)
