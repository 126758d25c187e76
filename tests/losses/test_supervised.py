"""Terms that compare a potential with labels: its value, the players', and branches that stay below the best one."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from hno.games import make
from hno.games.potential import Team
from hno.losses import Scales, View, losses, make_objective
from hno.operators.inputs import distinct_types
from hno.types import Field, Labels, Points, PotentialField, PotentialLabels, Sample
from tests.operators.conftest import random_points

GAME = make("narrow_road")
VALUE = torch.tensor([-10.0, -20.0, -30.0, -40.0])
BRANCH = torch.tensor([0, 1, 0, 1])
BEST = torch.tensor([True, True, False, True])


def field_of(branches: Tensor) -> PotentialField:
    """A potential of these branches, at the branch of each label."""
    rows = len(branches)
    value = branches.gather(-1, BRANCH.unsqueeze(-1))
    costate = torch.zeros(rows, 1, GAME.players, GAME.state_dim)
    return PotentialField(value, torch.zeros(rows, 1), costate, torch.zeros(rows, GAME.players), branches)


def view(field: Field | PotentialField, labels: Labels | PotentialLabels | None) -> View:
    points = random_points(GAME, 4)
    types = distinct_types(points.theta)._replace(branch=BRANCH)

    def nowhere(_: Points) -> Field:
        raise AssertionError("no term looks at other points")

    scales = Scales(torch.tensor(5.0), torch.ones(1, GAME.players, GAME.state_dim))
    return View(GAME, Team(GAME), Sample(points, labels, types), field, nowhere, scales, 0)


def potential_labels() -> PotentialLabels:
    costate = torch.zeros(4, 1, GAME.players, GAME.state_dim)
    return PotentialLabels(VALUE.unsqueeze(-1), costate, torch.ones(4, GAME.players), BEST)


def term(name: str):
    return losses.get(name)()


def test_other_branches_count_as_far_as_they_exceed_the_best_equilibrium() -> None:
    """The own branch counts nowhere, nor does any where the label itself is not the best of its start."""
    branches = torch.tensor([[99.0, -7.0], [-25.0, 99.0], [0.0, 99.0], [-40.0, 0.0]])
    found = term("branches").residual(view(field_of(branches), potential_labels()))
    assert found.tolist() == [[0, 3], [0, 0], [0, 0], [0, 0]]
    assert term("branches").scale(view(field_of(branches), potential_labels())) == 5


def test_a_branch_without_labels_exceeds_nothing_and_leaves_gradients_finite() -> None:
    free = torch.tensor([[-9.0, 0.0], [-15.0, -20.0], [-3.0, 0.0], [-39.0, -4.0]], requires_grad=True)
    branches = free.masked_fill(torch.tensor([False, True]), -torch.inf)
    found = term("branches").residual(view(field_of(branches), potential_labels()))
    assert found.tolist() == [[0, 0], [5, 0], [0, 0], [1, 0]]
    found.sum().backward()
    assert free.grad.tolist() == [[0, 0], [1, 0], [0, 0], [1, 0]]


def test_a_value_function_has_no_other_branches() -> None:
    value, costate = torch.randn(4, 2), torch.zeros(4, 2, 2, GAME.state_dim)
    seen = view(Field(value, value, costate), Labels(value + 1, costate))
    assert torch.equal(term("branches").residual(seen), torch.zeros(4, 2))
    assert torch.equal(term("value").residual(seen), value - (value + 1))


def test_the_value_of_a_potential_is_that_of_its_branch_and_of_every_player() -> None:
    branches = torch.tensor([[-9.0, 0.0], [0.0, -22.0], [-30.0, 0.0], [0.0, -40.0]])
    found = term("value").residual(view(field_of(branches), potential_labels()))
    assert found.tolist() == [[1, -1, -1], [-2, -1, -1], [0, -1, -1], [0, -1, -1]]
    seen = view(field_of(branches), potential_labels())
    assert torch.equal(term("costate").residual(seen), torch.zeros(4, 1, 2, GAME.state_dim))


@pytest.mark.parametrize("name", ["value", "costate", "branches"])
def test_points_alone_are_no_labels(name: str) -> None:
    with pytest.raises(ValueError, match="needs the labelled stream 'bvp'"):
        term(name).residual(view(field_of(torch.zeros(4, 2)), None))


def test_the_loss_of_branches_is_dimensionless() -> None:
    objective = make_objective({"branches": {}}, {"branches": 1.0})
    branches = torch.tensor([[-10.0, -5.0], [-20.0, -20.0], [0.0, 0.0], [-40.0, -40.0]])
    assert float(objective.reduced("branches", view(field_of(branches), potential_labels()))) == 1 / 8
