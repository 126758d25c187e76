"""A derivative of a value is right or refused, never finite and wrong."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from hno.control import Feedback
from hno.games import make
from hno.operators import Architecture, Choice, ValueOperator, make_operator
from hno.types import Field, Points, PotentialField
from tests.crossing import Crossing
from tests.operators.conftest import random_points, small_operator

REFUSED = "not differentiable in its points"
ASKED = ("value", "dvalue_dtau", "costate")


def potential(exact: bool) -> ValueOperator:
    torch.manual_seed(0)
    parts = Choice("potential", {"exact_terminal": exact}), Choice("deeponet", {"width": 8, "depth": 2}), Choice("sin")
    return make_operator(make("narrow_road"), Architecture(*parts))


OPERATORS: dict[str, Callable[[], ValueOperator]] = {
    "value": lambda: small_operator(exact_terminal=True),
    "free end": lambda: small_operator(exact_terminal=False),
    "by autograd": lambda: small_operator(activation="relu", exact_terminal=True),
    "ensemble": lambda: small_operator(exact_terminal=True, members=3),
    "three players": lambda: small_operator(Crossing(), exact_terminal=False),
    "potential": lambda: potential(exact=True),
    "potential, free end": lambda: potential(exact=False),
}


@pytest.fixture(params=OPERATORS)
def operator(request: pytest.FixtureRequest) -> ValueOperator:
    return OPERATORS[request.param]().double()


@pytest.mark.parametrize("frozen", [True, False])
@pytest.mark.parametrize("of", [0, 1, 2], ids=Points._fields)
def test_no_field_is_differentiated_in_its_points(operator: ValueOperator, frozen: bool, of: int) -> None:
    operator.requires_grad_(not frozen)
    points = Points(*(part.clone().requires_grad_(k == of) for k, part in enumerate(random_points(operator.game))))
    for field_of in (operator.field, *operator.members):
        field = field_of(points, None)
        for name in ASKED:
            with pytest.raises(RuntimeError, match=REFUSED):
                torch.autograd.grad(getattr(field, name).sum(), points[of], allow_unused=True)


@pytest.mark.parametrize("transform", ["grad", "jacrev", "jacfwd", "jvp"])
def test_no_transform_differentiates_a_field(operator: ValueOperator, transform: str) -> None:
    tau, x, theta = random_points(operator.game)

    def value(x: Tensor) -> Tensor:
        return operator.field(Points(tau, x, theta)).value.sum()

    def differentiated(x: Tensor) -> Any:
        if transform == "jvp":
            return torch.func.jvp(value, (x,), (torch.ones_like(x),))
        return getattr(torch.func, transform)(value)(x)

    with pytest.raises(RuntimeError, match=f"{REFUSED}|functorch"):  # torch refuses some kernels before we do
        differentiated(x)


def test_what_a_policy_says_of_a_batch_is_not_differentiated(operator: ValueOperator) -> None:
    policy, points = Feedback(operator.requires_grad_(False)), random_points(operator.game)
    x = points.x.clone().requires_grad_()
    for ask in (policy.act, policy.value, policy.costate):
        with pytest.raises(RuntimeError, match=REFUSED):
            torch.autograd.grad(ask(points.tau, x, points.theta).sum(), x)


def test_the_value_is_differentiated_right(operator: ValueOperator) -> None:
    """Central differences; of a potential it is the value of the branch that is played."""
    tau, x, theta = random_points(operator.game)
    x, step = x.requires_grad_(), 1e-6
    (slope,) = torch.autograd.grad(operator.value(tau, x, theta).sum(), x)
    for player in range(operator.game.players):
        for state in range(operator.game.state_dim):
            moved = torch.zeros_like(x)
            moved[:, player, state] = step
            ahead, behind = (operator.value(tau, x + sign * moved, theta).sum(-1) for sign in (1, -1))
            torch.testing.assert_close(slope[:, player, state], (ahead - behind) / (2 * step), rtol=1e-4, atol=1e-4)


def test_parameters_are_differentiated_beside_points_that_ask_for_it(operator: ValueOperator) -> None:
    points = random_points(operator.game)
    weights = list(operator.parameters())

    def slopes(at: Points) -> list[Tensor]:
        field: Field | PotentialField = operator.field(at)
        found = torch.autograd.grad(field.costate.square().sum(), weights, allow_unused=True)
        return [slope for slope in found if slope is not None]

    asked = points._replace(x=points.x.clone().requires_grad_())
    for ours, theirs in zip(slopes(asked), slopes(points), strict=True):
        assert torch.equal(ours, theirs)
