"""Held controls: the expansion is that of the cost, and descent lowers the cost of those who act."""

from __future__ import annotations

import itertools

import pytest
import torch
from torch import Tensor

from hno.games import make
from hno.pontryagin.descent import descend
from hno.pontryagin.expansion import Expansion
from hno.pontryagin.held_controls import HeldControls
from hno.pontryagin.integrate import runge_kutta
from tests.pontryagin.encounters import NAMES, encounters, types

ROWS = 4
EGOS = [None, torch.tensor([0, 1, 1, 0])]
"""The joint problem, and that of one player in each row."""
egos = pytest.mark.parametrize("ego", EGOS, ids=["joint", "alone"])


def setting(name: str, steps: int, ego: Tensor | None) -> tuple[HeldControls, Tensor, Tensor]:
    """A problem, start states before an encounter, and smooth scaled controls that differ for every player."""
    game, x0, theta = encounters(name, ROWS)
    x0 = torch.cat([x0[..., :-1] - 0.02 * game.state_box.width[:, :-1], x0[..., -1:]], -1)
    t = torch.linspace(0, 0.3 * game.horizon, steps + 1, dtype=x0.dtype)
    phase = torch.linspace(0, 3, ROWS * game.players * game.control_dim, dtype=x0.dtype)
    wave = 0.4 * torch.sin(torch.lerp(t[:-1], t[1:], 0.5).view(-1, 1) * 4 + phase)
    v = wave.unflatten(-1, (ROWS, game.players, game.control_dim)).movedim(1, 0)
    return HeldControls(game, t, theta, ego=ego, points=4), x0, v.contiguous()


def chained(model: Expansion, like: Tensor) -> Tensor:
    """Gradient of the cost in the controls, carried backward through the expansion."""
    ahead, slopes = model.gradient[:, -1], []
    for k in reversed(range(like.shape[1])):
        slopes.append(model.control_gradient[:, k] + torch.einsum("rdm,rd->rm", model.control_matrix[:, k], ahead))
        ahead = model.gradient[:, k] + torch.einsum("rde,rd->re", model.state_matrix[:, k], ahead)
    return torch.stack(slopes[::-1], 1).view_as(like)


@egos
@pytest.mark.parametrize("name", NAMES)
def test_the_gradient_is_that_of_the_cost_to_second_order_in_the_step(name, ego):
    """Drones move as double integrators, for which it is exact."""
    errors = []
    for steps in (10, 20, 40):
        problem, x0, v = setting(name, steps, ego)
        found = chained(problem.expand(problem.rollout(x0, v), v), v) * problem.acts[:, None, :, None]
        at = v.clone().requires_grad_()
        exact = torch.autograd.grad(problem.cost(problem.rollout(x0, at), at).sum(), at)[0]
        exact = exact * problem.acts[:, None, :, None]
        errors.append(float((found - exact).norm() / exact.norm()))
    assert errors[-1] < 1e-3
    for coarse, fine in itertools.pairwise(errors):
        assert fine < max(0.35 * coarse, 1e-12)


@egos
@pytest.mark.parametrize("name", NAMES)
def test_curvatures_are_positive_semidefinite(name, ego):
    problem, x0, v = setting(name, 12, ego)
    model = problem.expand(problem.rollout(x0, v), v)
    for hessian in (model.hessian, model.control_hessian):
        torch.testing.assert_close(hessian, hessian.mT)
        curvature = torch.linalg.eigvalsh(hessian)
        assert curvature.amin() > -1e-9 * curvature.amax()
    assert model.hessian[:, 1:-1].abs().amax() > 1


@egos
@pytest.mark.parametrize("name", NAMES)
def test_descent_never_raises_a_cost(name, ego):
    problem, x0, v = setting(name, 12, ego)
    costs = [problem.cost(problem.rollout(x0, v), v)]
    for iterations in (1, 2, 4, 8):
        x, moved, cost = descend(problem, x0, v, iterations, 1e-6)
        torch.testing.assert_close(x, problem.rollout(x0, moved))
        torch.testing.assert_close(cost, problem.cost(x, moved))
        assert moved.abs().max() <= 1
        assert (cost <= costs[-1]).all()
        costs.append(cost)
    assert (costs[-1] < costs[0]).all()


@pytest.mark.parametrize("name", NAMES)
def test_only_the_ego_moves(name):
    problem, x0, v = setting(name, 12, EGOS[1])
    x, moved, _ = descend(problem, x0, v, 8, 1e-6)
    others = 1 - problem.ego
    rows = torch.arange(ROWS)
    assert torch.equal(moved[rows, :, others], v[rows, :, others])
    assert torch.equal(x[rows, :, others], problem.rollout(x0, v)[rows, :, others])
    assert ((moved - v)[rows, :, problem.ego].flatten(1).abs().amax(-1) > 1e-3).all()


@pytest.mark.parametrize("name", NAMES)
def test_the_cost_with_an_ego_is_that_players_own(name):
    problem, x0, v = setting(name, 80, EGOS[1])
    game, u, x, spent = problem.game, problem.control(v), x0, torch.zeros_like(problem.theta)
    for k in range(problem.steps):
        dt = problem.dt[:, k, None, None]
        path = [x, runge_kutta(game, x, u[:, k], dt / 2), runge_kutta(game, x, u[:, k], dt)]
        rates = [game.running_cost(at, u[:, k], problem.theta) for at in path]
        spent = spent + dt[..., 0] / 6 * (rates[0] + 4 * rates[1] + rates[2])
        x = path[-1]
    own = (spent - game.terminal_value(x))[torch.arange(ROWS), problem.ego]
    torch.testing.assert_close(problem.cost(problem.rollout(x0, v), v), own, rtol=1e-3, atol=0)


def penalties(distance: float, ego: Tensor | None) -> Tensor:
    """How much more cars at a constant distance pay for types (5, 5) than for (1, 1): only the penalty differs."""
    game = make("narrow_road").double()
    x = torch.tensor([[30.0, 4.0, 0.0, 20.0], [game.length - 30.0 - distance, 4.0, 0.0, 20.0]], dtype=torch.float64)
    x, v = x.expand(1, 11, 2, 4), torch.zeros(1, 10, 2, 2, dtype=torch.float64)
    t = torch.linspace(0, 1, 11, dtype=torch.float64)
    costs = [HeldControls(game, t, types(1, kind, kind), ego=ego).cost(x, v) for kind in (5.0, 1.0)]
    return costs[0] - costs[1]


def test_the_joint_penalty_is_the_true_one_where_players_are_safe_and_grows_where_they_are_not():
    """And it counts once, for both players together."""
    ego, radius = torch.tensor([0]), 2.5
    safe, near = (penalties(radius + gap, ego) / penalties(radius + gap, None) for gap in (2.0, 0.5))
    torch.testing.assert_close(safe, torch.ones_like(safe), rtol=0, atol=1e-4)
    assert 0.8 < near < 1 - 1e-3
    deep = [penalties(0.2, who) for who in (None, ego)]
    assert deep[0] > 1e4 * 5 * 0.9
    assert deep[1] < 1e2
