"""Players who are interchangeable, three of them, and states that wrap around."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

from hno.games import Box, ControlAffineGame, make
from hno.operators import ValueOperator
from hno.types import Points
from tests.operators.conftest import MakeModule, MakeOperator, random_batch, random_points


class Crowd(ControlAffineGame):
    """Three pedestrians who choose their velocities; who has role 1 wants to end elsewhere."""

    horizon = 2.0

    def __init__(self, roles: tuple[int, int, int] = (0, 0, 0)) -> None:
        super().__init__()
        self.roles = roles
        self.state_box = Box([[-3, -2]] * 3, [[4, 3]] * 3)
        self.initial_box = Box([[-1, -1]] * 3, [[1, 1]] * 3)
        self.control_box = Box([-3, -3], [3, 3])
        self.type_box = Box([1] * 3, [5] * 3)
        self.register_buffer("input_matrix", torch.eye(2))
        self.register_buffer("effort_weight", torch.ones(2))
        self.register_buffer("goal", torch.tensor([[2.0, 1.0], [-1.0, 0.5]])[list(roles)])

    def drift(self, x: Tensor) -> Tensor:
        return torch.zeros_like(x)

    def positions(self, x: Tensor) -> Tensor:
        return x

    def terminal_value(self, x: Tensor) -> Tensor:
        return -(x - self.goal).square().sum(-1)

    def constraint(self, x: Tensor, theta: Tensor) -> Tensor:
        apart = (x.unsqueeze(-2) - x.unsqueeze(-3)).square().sum(-1).add(1e-9).sqrt()
        radii = 0.1 * (theta.unsqueeze(-1) + theta.unsqueeze(-2))
        others = ~torch.eye(3, dtype=torch.bool, device=x.device)
        return (radii - apart)[..., others].unflatten(-1, (3, 2))

    def sensors(self, theta: Tensor) -> Tensor:
        others = theta.sum(-1, keepdim=True) - theta
        return torch.stack([theta, others], -1) / 5


def agree(operator: ValueOperator, order: Sequence[int]) -> bool:
    """Whether permuted players have permuted values and costates, to rounding."""
    points, index = random_points(operator.game, 7), list(order)
    permuted = Points(points.tau, points.x[:, index], points.theta[:, index])
    here, there = operator.field(points), operator.field(permuted)
    pairs = [
        (there.value, here.value[:, index]),
        (there.dvalue_dtau, here.dvalue_dtau[:, index]),
        (there.costate, here.costate[:, index][:, :, index]),
        (operator.value(*permuted), operator.value(*points)[:, index]),
    ]
    return all(torch.allclose(found, expected, rtol=1e-10, atol=1e-10) for found, expected in pairs)


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
@pytest.mark.parametrize("options", [{}, {"exact_terminal": True, "members": 3}, {"activation": "sin"}])
def test_every_permutation_of_equal_players_permutes_their_values_and_costates(
    make_operator: MakeOperator, order: tuple[int, ...], options: dict[str, Any]
) -> None:
    operator = make_operator(Crowd(), **options).double()
    assert agree(operator, order)


def test_equal_players_differ_by_what_they_do(make_operator: MakeOperator) -> None:
    """An operator that ignored states or types would be symmetric, too."""
    operator = make_operator(Crowd()).double()
    points = random_points(operator.game, 7)
    field = operator.field(points)
    assert not torch.allclose(field.value[:, 0], field.value[:, 1], rtol=1e-3)
    moved = points._replace(theta=points.theta[:, [0, 2, 1]])
    assert not torch.allclose(operator.field(moved).value[:, 0], field.value[:, 0], rtol=1e-6)
    for player, other in itertools.permutations(range(3), 2):
        assert bool((field.costate[:, player, other].abs() > 1e-6).any())


def test_only_players_of_one_role_are_interchangeable(make_operator: MakeOperator) -> None:
    operator = make_operator(Crowd((0, 1, 1)), exact_terminal=True).double()
    assert agree(operator, (0, 2, 1))
    others = [order for order in itertools.permutations(range(3)) if order[0] != 0]
    assert not any(agree(operator, order) for order in others)


def test_field_of_three_is_the_jacobian_of_their_values(make_operator: MakeOperator) -> None:
    operator = make_operator(Crowd((0, 1, 1)), exact_terminal=True).double()
    points = random_points(operator.game, 4)
    field = operator.field(points)
    value = lambda tau, x, theta: operator.value(tau[None], x[None], theta[None])[0]  # noqa: E731  # for jacrev
    for row, at in enumerate(zip(*points, strict=True)):
        in_time, in_state = torch.func.jacrev(value, argnums=(0, 1))(*at)
        torch.testing.assert_close(field.dvalue_dtau[row], in_time)
        torch.testing.assert_close(field.costate[row], in_state)


def test_symmetry_survives_training(make_module: MakeModule) -> None:
    module = make_module(Crowd())
    batch, optimizer = random_batch(module.operator.game), torch.optim.Adam(module.operator.parameters(), 1e-2)
    first = module.training_step(batch, 0).item()
    for step in range(5):
        optimizer.zero_grad()
        loss = module.training_step(batch, step)
        loss.backward()
        optimizer.step()
    assert loss.item() != first
    assert all(agree(module.operator.double(), order) for order in itertools.permutations(range(3)))


@pytest.fixture(params=[2, 3], ids=["two players", "three players"])
def turning(request: pytest.FixtureRequest, make_operator: MakeOperator) -> ValueOperator:
    """An operator of a game one of whose states is an angle, in double precision; V(0) depends on the angle too."""
    game, angle = (make("narrow_road"), 2) if request.param == 2 else (Crowd(), 1)
    game.periodic = (angle,)
    operator = make_operator(game).double()
    operator.game.state_box.lo[:, angle], operator.game.state_box.hi[:, angle] = -math.pi, math.pi
    return operator


def test_the_field_repeats_after_a_turn(turning: ValueOperator) -> None:
    (angle,) = turning.game.periodic
    points = random_points(turning.game)
    here = turning.field(points)
    for player, turns in itertools.product(range(turning.game.players), (-1, 2)):
        x = points.x.clone()
        x[:, player, angle] += 2 * math.pi * turns
        for part, other in zip(here, turning.field(points._replace(x=x)), strict=True):
            torch.testing.assert_close(part, other, rtol=1e-9, atol=1e-9)
        x[:, player, angle] += 1.0
        assert not torch.allclose(turning.field(points._replace(x=x)).value, here.value, rtol=1e-4)


def test_costates_of_angles_agree_with_finite_differences(turning: ValueOperator) -> None:
    tau, x, theta = random_points(turning.game, 5)
    x[0, :, turning.game.periodic[0]] = math.pi  # where the scaled state would jump
    field, step = turning.field(Points(tau, x, theta)), 1e-6
    for player, state in itertools.product(range(turning.game.players), range(turning.game.state_dim)):
        moved = torch.zeros_like(x)
        moved[:, player, state] = step
        slope = (turning(tau, x + moved, theta) - turning(tau, x - moved, theta)) / (2 * step)
        torch.testing.assert_close(field.costate[:, :, player, state], slope, rtol=1e-5, atol=1e-6)
    assert bool(field.costate[..., turning.game.periodic[0]].abs().amax() > 1e-3)
