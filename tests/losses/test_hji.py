"""The residual of the Hamilton-Jacobi-Isaacs equation vanishes on exact values, and on nothing else."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from hno.games import make
from hno.games.potential import Team
from hno.losses import Scales, View, hji_residual, losses
from hno.types import Field, Points, PotentialField, Sample
from tests.lq import LinearQuadratic, feedback_riccati_rate, quadratic, random_game


def view(game, at: Points, field: Field) -> View:
    """What a term sees at some points, where nothing asks for others."""

    def nowhere(_: Points) -> Field:
        raise AssertionError("no term looks at other points")

    return View(game, game, Sample(at), field, nowhere, Scales(torch.tensor(1.0), torch.tensor(1.0)), 0)


def points(game, size: int = 32, seed: int = 0) -> Points:
    generator = torch.Generator().manual_seed(seed)
    tau = game.horizon * torch.rand(size, generator=generator, dtype=torch.float64)
    return Points(tau, game.state_box.sample(size, generator), game.type_box.sample(size, generator))


def regulators() -> LinearQuadratic:
    """Uncoupled players x' = u with costs q x^2 + u^2 and no terminal cost."""
    one = torch.ones(2, 1, 1, dtype=torch.float64)
    running = torch.diag_embed(torch.diag(torch.tensor([1.0, 4.0], dtype=torch.float64)))
    return LinearQuadratic(0 * one, one, one[..., 0], running, 0 * running).double()


def regulator_field(at: Points) -> Field:
    """V_i = -sqrt(q) tanh(sqrt(q) tau) x_i^2."""
    root = torch.tensor([1.0, 2.0], dtype=torch.float64)
    slope = root * torch.tanh(root * at.tau[:, None])
    rate = root.square() / torch.cosh(root * at.tau[:, None]).square()
    state = at.x[..., 0]
    own = torch.diag_embed(-2 * slope * state)
    return Field(-slope * state.square(), -rate * state.square(), own.unsqueeze(-1))


def feedback_field(game: LinearQuadratic, k: Tensor, at: Points) -> Field:
    """V_i = -x' K_i x with dK_i / dtau from the coupled feedback Riccati equations."""
    costate = torch.einsum("pab,rb->rpa", -2 * k, at.x.flatten(-2)).unflatten(-1, at.x.shape[-2:])
    return Field(-quadratic(k, at.x), -quadratic(feedback_riccati_rate(game, k), at.x), costate)


def symmetric(game: LinearQuadratic) -> Tensor:
    root = torch.randn(game.q.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return root @ root.mT / root.shape[-1]


def test_exact_values_of_regulators_solve_the_equation():
    game = regulators()
    at = points(game)
    assert hji_residual(game, at, regulator_field(at)).abs().max() < 1e-12


def test_exact_values_of_regulators_meet_the_boundary():
    game = regulators()
    at = points(game)._replace(tau=torch.zeros(32, dtype=torch.float64))
    assert losses.get("boundary")().residual(view(game, at, regulator_field(at))).abs().max() == 0


@pytest.mark.parametrize("players", [2, 3])
def test_feedback_equilibria_of_coupled_players_solve_the_equation(players):
    """Each player's value changes with everybody's optimal control: the cross costates count."""
    game = random_game(players, seed=players)
    at = points(game)
    field = feedback_field(game, symmetric(game), at)
    size = game.hamiltonian(at.x, field.costate, game.optimal_control(at.x, field.costate), at.theta).abs().max()
    assert size > 1
    assert hji_residual(game, at, field).abs().max() < 1e-12 * size


@pytest.mark.parametrize("part", ["dvalue_dtau", "costate"])
def test_a_wrong_derivative_leaves_a_residual(part):
    game = random_game(2)
    at = points(game)
    field = feedback_field(game, symmetric(game), at)
    for flipped in (-1.0, 1.01):
        wrong = field._replace(**{part: flipped * getattr(field, part)})
        assert (hji_residual(game, at, wrong).abs().amax(-1) > 1e-4).all()


def test_wrong_cross_costates_leave_a_residual():
    game = random_game(2)
    at = points(game)
    field = feedback_field(game, symmetric(game), at)
    costate = field.costate.clone()
    costate[:, 0, 1] *= 1.01
    residual = hji_residual(game, at, field._replace(costate=costate)).abs()
    assert residual[:, 0].median() > 1e-3
    assert residual[:, 1].max() < 1e-9


def test_a_saturated_control_enters_with_its_bound():
    """Beyond the box, max over u of lambda u - u^2 is lambda u_max - u_max^2."""
    game = regulators()
    game.control_box.hi.fill_(0.5)
    game.control_box.lo.fill_(-0.25)
    x = torch.zeros(2, 2, 1, dtype=torch.float64)
    costate = torch.diag_embed(torch.tensor([[3.0, -3.0], [0.8, -0.4]], dtype=torch.float64)).unsqueeze(-1)
    still = torch.zeros(2, 2, dtype=torch.float64)
    at = Points(torch.ones(2, dtype=torch.float64), x, still)
    residual = hji_residual(game, at, Field(still, still, costate))
    assert -residual.flatten() == pytest.approx([1.5 - 0.25, 0.75 - 0.0625, 0.16, 0.04])


@pytest.mark.parametrize("name", ["narrow_road", "lane_change", "drone"])
def test_at_rest_the_residual_is_the_penalty_at_the_rows_own_types(name):
    """With zero costates the optimal effort is 0, so dV/dtau = 0 leaves the penalty alone."""
    game = make(name).double()
    at = points(game)
    still = torch.zeros(32, 2, dtype=torch.float64)
    costate = torch.zeros(32, 2, *at.x.shape[1:], dtype=torch.float64)
    penalty = game.penalty(at.x, at.theta)
    torch.testing.assert_close(hji_residual(game, at, Field(still, still, costate)), penalty, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ["narrow_road", "lane_change", "drone"])
def test_the_boundary_has_the_sign_of_rewards(name):
    game = make(name).double()
    at = points(game)
    boundary, target = losses.get("boundary")(), game.terminal_value(at.x)
    nothing = torch.zeros(32, 2, *at.x.shape[1:], dtype=torch.float64)
    assert boundary.residual(view(game, at, Field(target, target, nothing))).abs().max() == 0
    wrong = boundary.residual(view(game, at, Field(-target, target, nothing)))
    torch.testing.assert_close(wrong, -2 * target)


def test_the_gradient_reaches_the_costates_through_free_controls_only():
    """Where the control is free its derivative cancels (envelope); where it is clipped it has none."""
    game = random_game(2)
    at = points(game)
    field = feedback_field(game, symmetric(game), at)
    costate = field.costate.clone().requires_grad_()
    residual = hji_residual(game, at, field._replace(costate=costate))[:, 0].sum()
    own = torch.autograd.grad(residual, costate)[0][:, 0, 0]
    u = game.optimal_control(at.x, field.costate)
    torch.testing.assert_close(own, -game.dynamics(at.x, u)[:, 0])


def test_any_batch_shape_of_points():
    game = random_game(3)
    at = points(game)
    field = feedback_field(game, symmetric(game), at)
    flat = hji_residual(game, at, field)
    grid_points = Points(*(part.unflatten(0, (4, 8)) for part in at))
    grid = hji_residual(game, grid_points, Field(*(part.unflatten(0, (4, 8)) for part in field[:3])))
    torch.testing.assert_close(grid.flatten(0, 1), flat)


def test_the_potential_of_uncoupled_regulators_is_the_sum_of_their_values() -> None:
    """W = V_1 + V_2 meets the one scalar equation, and neither V_1 alone nor W of another rate does."""
    game = regulators()
    game.potential = True
    at, team = points(game), Team(game)
    of_players = regulator_field(at)
    own = of_players.costate.diagonal(dim1=-3, dim2=-2).mT.unsqueeze(-3)
    total, rate = (part.sum(-1, keepdim=True) for part in (of_players.value, of_players.dvalue_dtau))
    field = PotentialField(total, rate, own, of_players.value, total)
    assert float(hji_residual(team, at, field).abs().max()) < 1e-9
    assert float(hji_residual(team, at, field._replace(dvalue_dtau=0.9 * rate)).abs().max()) > 0.1
    one = own * torch.tensor([[1.0], [0.0]])
    assert float(hji_residual(team, at, field._replace(costate=one)).abs().max()) > 0.1
