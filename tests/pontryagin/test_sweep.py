"""The backward sweep gives the gradient and the value of a trajectory, to fourth order."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from hno.games import Game
from hno.pontryagin.integrate import runge_kutta
from hno.pontryagin.sweep import costates, values
from tests.lq import open_loop_nash, random_game
from tests.pontryagin.encounters import NAMES, central_difference, encounters


def swept(game, x0: Tensor, intervals: int) -> tuple[float, float]:
    """Largest errors of costates and values along an exact equilibrium of a linear-quadratic game."""
    t = torch.linspace(0, game.horizon, 2 * intervals + 1, dtype=x0.dtype)
    exact = open_loop_nash(game, x0, t)
    nodes, middle = (exact.x[:, ::2], exact.u[:, ::2]), (exact.x[:, 1::2], exact.u[:, 1::2])
    arguments = game, t[::2].expand(len(x0), -1), *nodes, middle, torch.zeros(x0.shape[:2], dtype=x0.dtype)
    costate, value = costates(*arguments), values(*arguments)
    return float((costate - exact.costate[:, ::2]).abs().max()), float((value - exact.value[:, ::2]).abs().max())


@pytest.mark.parametrize("players", [2, 3])
def test_exact_costates_and_values_to_fourth_order(players):
    game = random_game(players, seed=players)
    x0 = game.initial_box.sample(3, torch.Generator().manual_seed(0))
    coarse, fine = swept(game, x0, 10), swept(game, x0, 20)
    for error, halved in zip(coarse, fine, strict=True):
        assert halved < 1e-5
        assert 12 < error / halved < 20


def test_an_uneven_mesh_keeps_the_order():
    game = random_game(2)
    x0 = game.initial_box.sample(3, torch.Generator().manual_seed(0))
    errors = []
    for intervals in (20, 40):
        nodes = torch.linspace(0, 1, intervals + 1, dtype=x0.dtype) ** 2
        t = torch.stack([nodes[:-1], (nodes[:-1] + nodes[1:]) / 2], -1).flatten()
        exact = open_loop_nash(game, x0, torch.cat([t, nodes[-1:]]))
        parts = (exact.x[:, ::2], exact.u[:, ::2]), (exact.x[:, 1::2], exact.u[:, 1::2])
        found = costates(game, nodes.expand(3, -1), *parts[0], parts[1], torch.zeros(3, 2, dtype=x0.dtype))
        errors.append(float((found - exact.costate[:, ::2]).abs().max()))
    assert errors[1] < 1e-5
    assert 12 < errors[0] / errors[1] < 20


def play(game: Game, x0: Tensor, theta: Tensor, u: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """States at step ends and values under held controls u (B, P, m)."""
    x, dt, path, spent = x0, 0.3 / steps, [x0], torch.zeros_like(theta)
    for _ in range(steps):
        middle, after = runge_kutta(game, x, u, dt / 2), runge_kutta(game, x, u, dt)
        costs = [game.running_cost(at, u, theta) for at in (x, middle, after)]
        spent = spent + dt / 6 * (costs[0] + 4 * costs[1] + costs[2])
        path += [middle, after]
        x = after
    return torch.stack(path, 1), game.terminal_value(x) - spent


@pytest.mark.parametrize("name", NAMES)
def test_costates_of_any_trajectory_are_the_gradient_of_the_value(name):
    """Own and cross costates, at controls that are not optimal."""
    game, x0, theta = encounters(name, size=3)
    u = game.control_box.sample(6, torch.Generator().manual_seed(2)).unflatten(0, (3, 2))
    steps = 60
    x, value = play(game, x0, theta, u, steps)
    t = torch.linspace(0, 0.3, steps + 1, dtype=x.dtype).expand(3, -1)
    held = u.unsqueeze(1).expand(-1, steps + 1, -1, -1)
    arguments = game, t, x[:, ::2], held, (x[:, 1::2], held[:, 1:]), theta
    found, sizes = costates(*arguments), values(*arguments)
    slope = central_difference(lambda at: play(game, at, theta, u, steps)[1], x0)
    torch.testing.assert_close(found[:, 0], slope, rtol=1e-5, atol=1e-5 * float(slope.abs().max()))
    torch.testing.assert_close(sizes[:, 0], value, rtol=1e-10, atol=0)
    torch.testing.assert_close(sizes[:, -1], game.terminal_value(x[:, -1]))
