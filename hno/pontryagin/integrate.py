"""Runge-Kutta steps."""

from __future__ import annotations

from torch import Tensor

from hno.games import Game


def runge_kutta(
    game: Game,
    x: Tensor,
    u: Tensor,
    dt: float | Tensor,
    later: tuple[Tensor, Tensor] | None = None,
    push: Tensor | None = None,
) -> Tensor:
    """One classical Runge-Kutta step of the dynamics.

    Args:
        game: the game.
        x: states, (B, P, n).
        u: controls, (B, P, m).
        dt: step, s; a tensor must broadcast against x.
        later: controls in the middle and at the end of the step; u is held without them.
        push: constant that is added to the time derivative of the state, broadcastable to x.

    Returns:
        States after the step, (B, P, n).
    """

    def rate(x: Tensor, u: Tensor) -> Tensor:
        return game.dynamics(x, u) if push is None else game.dynamics(x, u) + push

    middle, end = later or (u, u)
    first = rate(x, u)
    second = rate(x + dt / 2 * first, middle)
    third = rate(x + dt / 2 * second, middle)
    fourth = rate(x + dt * third, end)
    return x + dt / 6 * (first + 2 * second + 2 * third + fourth)
