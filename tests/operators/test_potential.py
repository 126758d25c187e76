"""The operator of a potential: its derivatives, its branches, and the controls that they give."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from hno.control import Feedback
from hno.games import Game, make
from hno.games.potential import Team
from hno.losses import Scales
from hno.operators import Architecture, Choice, ValueOperator
from hno.operators import make_operator as built
from hno.operators.inputs import distinct_types
from hno.types import Points
from tests.crossing import Merging
from tests.lq import random_game
from tests.operators.conftest import random_points, small_operator

GAMES = ("narrow_road", "lane_change", "drone", "intersection", "three")
TIGHT = {"rtol": 1e-9, "atol": 1e-9}


def potential_operator(game: str | Game, activation: str = "sin", **options: Any) -> ValueOperator:
    torch.manual_seed(0)
    chosen = Choice("potential", options), Choice("deeponet", {"width": 16, "depth": 2}), Choice(activation)
    game = game if isinstance(game, Game) else Merging(3) if game == "three" else make(game)
    operator = built(game, Architecture(*chosen)).double().requires_grad_(False)
    operator.set_scales(Scales(torch.tensor(40.0), torch.full_like(operator.costate_scale, 3.0)))
    return operator


def potential(operator: ValueOperator, points: Points, branch: Tensor | None = None) -> Tensor:
    """W of the best branch or of given ones by the pure function, differentiable in the points."""
    heads = operator._functions(*points, operator._heads(*points).median(0).values)[0]
    return heads.amax(-1) if branch is None else heads.gather(-1, branch.unsqueeze(-1)).squeeze(-1)


@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize("game", GAMES)
def test_the_field_holds_the_derivatives_of_the_potential(game: str, exact: bool) -> None:
    operator = potential_operator(game, exact_terminal=exact)
    tau, x, theta = random_points(operator.game, 7)
    tau, x = tau.requires_grad_(), x.requires_grad_()
    field = operator.field(Points(tau.detach(), x.detach(), theta))
    value = potential(operator, Points(tau, x, theta))
    rate, costate = torch.autograd.grad(value.sum(), (tau, x))
    torch.testing.assert_close(field.value.squeeze(-1), value.detach(), **TIGHT)
    torch.testing.assert_close(field.players, operator.value(tau, x, theta).detach(), **TIGHT)
    torch.testing.assert_close(field.dvalue_dtau.squeeze(-1), rate, **TIGHT)
    torch.testing.assert_close(field.costate.squeeze(-3), costate, **TIGHT)


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_every_activation_gives_the_same_derivatives_by_both_ways(activation: str) -> None:
    operator = potential_operator("drone", activation)
    points = random_points(operator.game, 5)
    torch.testing.assert_close(
        operator.field(points).costate[0],
        operator.value_and_costate(*(column[0] for column in points))[1],
        **TIGHT,
    )


def test_points_may_belong_to_a_branch_and_others_take_the_best() -> None:
    operator = potential_operator("narrow_road")
    points = random_points(operator.game, 9)
    branch = torch.tensor([0, 1, -1] * 3)
    field = operator.field(points, distinct_types(points.theta)._replace(branch=branch))
    best = field.branches.argmax(-1)
    played = torch.where(branch < 0, best, branch)
    torch.testing.assert_close(field.value, field.branches.gather(-1, played.unsqueeze(-1)), **TIGHT)
    x = points.x.clone().requires_grad_()
    (costate,) = torch.autograd.grad(potential(operator, points._replace(x=x), played).sum(), x)
    torch.testing.assert_close(field.costate.squeeze(-3), costate, **TIGHT)


def test_a_branch_without_labels_is_not_played() -> None:
    operator = potential_operator("narrow_road")
    points = random_points(operator.game, 64)
    assert set(Feedback(operator).branch(*points).tolist()) == {0, 1}
    operator.set_branches(torch.tensor([1, 1]))
    assert set(Feedback(operator).branch(*points).tolist()) == {1}
    assert bool(operator.field(points).value.isfinite().all())


@pytest.mark.parametrize("game", GAMES)
def test_the_terminal_condition_holds_exactly(game: str) -> None:
    operator = potential_operator(game)
    points = random_points(operator.game, 6)._replace(tau=torch.zeros(6, dtype=torch.float64))
    field, rewards = operator.field(points), operator.game.terminal_value(points.x)
    torch.testing.assert_close(field.value, rewards.sum(-1, keepdim=True), **TIGHT)
    torch.testing.assert_close(field.players, rewards, **TIGHT)
    assert torch.equal(field.branches, field.value.expand_as(field.branches))


@pytest.mark.parametrize("game", GAMES)
def test_controls_maximise_the_hamiltonian_of_the_team(game: str) -> None:
    operator = potential_operator(game)
    points = random_points(operator.game, 64)
    costate, team, box = operator.field(points).costate, Team(operator.game), operator.game.control_box
    best = team.hamiltonian(points.x, costate, Feedback(operator).act(*points), points.theta)
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        u = box.lo + box.width * torch.rand(
            64, operator.game.players, operator.game.control_dim, generator=generator, dtype=torch.float64
        )
        assert bool((team.hamiltonian(points.x, costate, u, points.theta) <= best + 1e-9).all())


def test_few_and_many_branch_inputs_give_the_same_values(monkeypatch: pytest.MonkeyPatch) -> None:
    """One product for all of them, or a look-up for each row."""
    operator = potential_operator("narrow_road").requires_grad_()
    points = random_points(operator.game, 9)
    found = []
    for limit in (10**6, 0):
        monkeypatch.setattr("hno.operators.deeponet.TABLE", limit)
        field = operator.field(points)
        gradient = torch.autograd.grad(field.branches.sin().sum() + field.players.cos().sum(), operator.parameters())
        found.append((field.branches, field.players, *gradient))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, **TIGHT)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_the_field_needs_no_gradients_from_outside(mode: Any) -> None:
    operator = potential_operator("drone")
    points = random_points(operator.game, 5)
    wanted = operator.field(points)
    with mode():
        for part, other in zip(operator.field(Points(*(column.clone() for column in points))), wanted, strict=True):
            torch.testing.assert_close(part, other, **TIGHT)


def test_torch_transforms_take_the_answer() -> None:
    policy = Feedback(potential_operator("three"))
    points = random_points(policy.game, 5)
    answers = torch.vmap(policy.answer)(*points)
    torch.testing.assert_close(answers.value, policy.value(*points), **TIGHT)
    torch.testing.assert_close(answers.costate, policy.costate(*points), **TIGHT)
    torch.testing.assert_close(answers.control, policy.act(*points), **TIGHT)
    assert policy.costate(*points).shape == (5, 1, 3, 4)


def test_an_ensemble_plays_the_branch_of_the_median_and_answers_alike_by_both_ways() -> None:
    operator = potential_operator("narrow_road", members=3)
    points = random_points(operator.game, 64)
    field, members = operator.field(points), [member(points, None) for member in operator.members]
    branches = torch.stack([member.branches for member in members]).median(0).values
    torch.testing.assert_close(field.branches, branches, **TIGHT)
    best = distinct_types(points.theta)._replace(branch=branches.argmax(-1))
    same = [member(points, best) for member in operator.members]
    for part in ("value", "dvalue_dtau"):
        torch.testing.assert_close(
            getattr(field, part), torch.stack([getattr(one, part) for one in same]).median(0).values, **TIGHT
        )
    answers = torch.vmap(Feedback(operator).answer)(*points)
    torch.testing.assert_close(answers.costate, field.costate, **TIGHT)
    torch.testing.assert_close(answers.value, field.players, **TIGHT)


def test_games_without_a_potential_are_refused() -> None:
    game = random_game(2)
    with pytest.raises(ValueError, match=r"LinearQuadratic does not say that it is one .*function=value"):
        potential_operator(game)
    game.potential = True
    with pytest.raises(ValueError, match=r"LinearQuadratic misses by .* of the cost"):
        potential_operator(game)


def test_a_policy_of_values_has_no_branches() -> None:
    policy = Feedback(small_operator("narrow_road"))
    with pytest.raises(ValueError, match="train it with function=potential"):
        policy.branch(torch.zeros(1), torch.zeros(1, 2, 4), torch.ones(1, 2))
