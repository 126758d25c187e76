"""The same equilibria one by one with `scipy.integrate.solve_bvp`: the cross-check and baseline of `solve`."""

from __future__ import annotations

import copy
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.integrate import solve_bvp
from torch import Tensor

from hno.games import Game
from hno.games.base import own_costate
from hno.pontryagin.adjoint import pmp_rate, terminal_costate
from hno.pontryagin.collocation import Iterate
from hno.pontryagin.held_controls import HeldControls
from hno.pontryagin.mesh import label_times
from hno.pontryagin.starts import manoeuvres
from hno.pontryagin.sweep import costates


class Reference(NamedTuple):
    """The cheapest converged attempt, or none."""

    converged: bool
    """Whether any start converged."""
    value: Tensor
    """V_i from the start, NaN without a converged attempt, (P,)."""
    x: Tensor
    """States on the label grid, (K, P, n)."""
    own: Tensor
    """Own costates on the label grid, (K, P, n)."""
    path: Iterate
    """The same on a fine uniform grid, one row."""


def solve_one(
    game: Game, x0: Tensor, theta: Tensor, starts: int = 4, amplitude: float = 0.06, tolerance: float = 5e-3
) -> Reference:
    """The cheapest of several attempts at Pontryagin's conditions from one start state; arguments as for `attempts`."""
    found = attempts(game, x0, theta, starts, amplitude, tolerance)
    return max(found, key=lambda attempt: float(attempt.value.sum().nan_to_num(-torch.inf)))


def attempts(
    game: Game, x0: Tensor, theta: Tensor, starts: int = 4, amplitude: float = 0.06, tolerance: float = 5e-3
) -> list[Reference]:
    """Solve Pontryagin's conditions from one start state and several manoeuvres.

    Args:
        game: the game.
        x0: start state, (P, n).
        theta: player types, (P,).
        starts: how many manoeuvres the iteration starts from, in the order of `manoeuvres`, without "none".
        amplitude: size of the manoeuvres, in half widths of the control box.
        tolerance: relative residual that `solve_bvp` accepts.
    """
    game = copy.deepcopy(game).double()
    x0, theta = x0.double(), theta.double()
    t = label_times(game, dtype=x0.dtype, device=x0.device)
    shapes = manoeuvres(game, game.players, dtype=x0.dtype, device=x0.device)[1 : starts + 1]
    return [_attempt(game, x0, theta, t, amplitude * shape, tolerance) for shape in shapes]


def _attempt(game: Game, x0: Tensor, theta: Tensor, t: Tensor, shape: Tensor, tolerance: float) -> Reference:
    states, own = _initial_guess(game, x0, theta, t, shape)
    guess = torch.cat([states.flatten(1), own.flatten(1)], -1).T.numpy()
    half, sizes = x0.numel(), x0.shape

    def split(z: NDArray[np.float64]) -> tuple[Tensor, Tensor]:
        joint = torch.from_numpy(np.ascontiguousarray(z.T))
        return joint[:, :half].unflatten(-1, sizes), joint[:, half:].unflatten(-1, sizes)

    def rate(_: NDArray[np.float64], z: NDArray[np.float64]) -> NDArray[np.float64]:
        x, costate = split(z)
        rates = pmp_rate(game, x, costate, theta.expand(len(x), -1))
        return torch.cat([part.flatten(1) for part in rates], -1).T.numpy()

    def boundary(first: NDArray[np.float64], last: NDArray[np.float64]) -> NDArray[np.float64]:
        x, costate = split(last[:, None])
        end = costate - own_costate(terminal_costate(game, x))
        return np.concatenate([first[:half] - x0.flatten().numpy(), end.flatten().numpy()])

    found = solve_bvp(rate, boundary, t.numpy(), guess, tol=tolerance, max_nodes=5000)
    x, costate = split(found.sol(t.numpy()))
    fine = np.linspace(0, game.horizon, 4001)
    samples, sampled = torch.from_numpy(fine), found.sol(fine)
    value = _value(game, samples, *split(sampled), theta)
    joint = torch.from_numpy(np.ascontiguousarray(sampled.T))[::4]
    path = Iterate(samples[None, ::4], joint.unsqueeze(0), theta.unsqueeze(0))
    return Reference(found.success, value if found.success else torch.full_like(value, torch.nan), x, costate, path)


def _initial_guess(game: Game, x0: Tensor, theta: Tensor, t: Tensor, shape: Tensor) -> tuple[Tensor, Tensor]:
    """States and own costates on the label grid of a manoeuvre around the controls of a player at rest."""
    problem = HeldControls(game, t, theta.unsqueeze(0))
    neutral = problem.scaled(game.best_response(x0, torch.zeros_like(x0)))
    v = (neutral + shape).clamp(-1, 1).unsqueeze(0)
    x, u = problem.rollout(x0.unsqueeze(0), v), problem.control(v)
    middle = (x[:, 1:] + x[:, :-1]) / 2, u
    own = own_costate(costates(game, t.unsqueeze(0), x, torch.cat([u, u[:, -1:]], 1), middle, theta.unsqueeze(0)))
    return x[0], own[0]


def _value(game: Game, t: Tensor, x: Tensor, own: Tensor, theta: Tensor) -> Tensor:
    """V_i from the start, by the trapezoidal rule on a fine grid, (P,)."""
    cost = game.running_cost(x, game.best_response(x, own), theta.expand(len(x), -1))
    return game.terminal_value(x[-1]) - torch.trapezoid(cost, t, dim=0)
