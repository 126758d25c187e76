"""Branches: the rotation that players sweep around each other tells ways around apart."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from hno.data.branches import branch_of, principal_axes, rotations
from hno.data.rows import best_equilibria, orders, potential_rows
from hno.games import Game, make
from hno.types import Extremal
from tests.crossing import Merging
from tests.fakes import fake_labels


def passing(game: Game, offset: Tensor, lift: float = 0.0) -> Tensor:
    """Player 2 passes player 1, who stands still, at a lateral offset: states of one trajectory each, (B, K, P, n)."""
    x = torch.zeros(len(offset), 41, 2, game.state_dim, dtype=torch.float64)
    x[:, :, 1, 0] = torch.linspace(-20, 20, 41, dtype=torch.float64)
    x[:, :, 1, 1] = offset.unsqueeze(-1)
    if game.state_dim == 6:
        x[:, :, 1, 2] = lift
    return x


def test_a_full_circle_is_a_full_angle() -> None:
    game, angle = Merging(2), torch.linspace(0, 2 * math.pi, 30, dtype=torch.float64)
    x = torch.zeros(1, 30, 2, 4, dtype=torch.float64)
    x[0, :, 1, 0], x[0, :, 1, 1] = 3 * angle.cos(), 3 * angle.sin()
    torch.testing.assert_close(rotations(game, x)[0, 0], torch.tensor([0, 0, 2 * math.pi]).double())


def test_sides_have_opposite_signs_and_a_common_shift_changes_nothing() -> None:
    game, offset = make("lane_change").double(), torch.tensor([2.0, -2.0], dtype=torch.float64)
    x = passing(game, offset)
    turned = rotations(game, x)[:, 0, 2]
    assert turned[0] < -2
    assert turned[1] > 2
    shift = torch.randn(4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(rotations(game, x + shift)[:, 0, 2], turned)
    torch.testing.assert_close(rotations(game, x.flip(2))[:, 0, 2], turned)
    assert len(set(branch_of(game, x, torch.tensor([[0.0, 0, 1]]).double()).tolist())) == 2


def two_each(game: Game, x: Tensor) -> Extremal:
    """Equilibria of which every two in a row belong to one start."""
    found = fake_labels(game, count=len(x))
    start = torch.arange(len(x)) // 2
    return found._replace(x=x[:, : len(found.t)].contiguous(), start=start)


def test_the_axis_is_the_one_along_which_equilibria_differ() -> None:
    """Drones that pass above or below each other, each side at several lateral offsets: the axis lies in the plane."""
    game = make("drone").double()
    x = torch.cat([passing(game, torch.tensor([o, o]).double()) for o in (-0.3, 0.0, 0.4)])
    x[::2, :, 1, 2], x[1::2, :, 1, 2] = 1.0, -1.0
    (axis,) = principal_axes(game, [two_each(game, x)])
    assert abs(float(axis[2])) < 0.1
    branch = branch_of(game, x, axis.unsqueeze(0))
    assert branch[::2].unique().numel() == branch[1::2].unique().numel() == 1
    assert branch[0] != branch[1]


def test_three_players_have_a_side_for_every_pair() -> None:
    game = Merging(3)
    x = game.state_box.sample(50 * 21, torch.Generator().manual_seed(0)).double().unflatten(0, (50, 21))
    assert rotations(game, x).shape == (50, 3, 3)
    branch = branch_of(game, x, torch.tensor([[0.0, 0, 1]] * 3).double())
    assert int(branch.min()) >= 0
    assert len(branch.unique()) == 8


@pytest.mark.parametrize("name", ["narrow_road", "lane_change", "drone"])
def test_swapped_rows_say_the_same_of_swapped_players(name: str) -> None:
    game = make(name)
    found = fake_labels(game, (1.0, 4.0), count=3)
    axes = torch.tensor([[0.6, 0.0, 0.8]]).double()
    plain, both = (potential_rows(game, [found], axes, swapped=swapped) for swapped in (False, True))
    count = len(list(orders(game)))
    assert both.size == count * plain.size == count * 3 * len(found.t)
    if count == 2:
        rest = both.rows(torch.arange(plain.size, both.size))
        assert torch.equal(rest.points.x, plain.points.x.flip(-2))
        assert torch.equal(rest.points.theta, plain.points.theta.flip(-1))
        assert torch.equal(rest.labels.value, plain.labels.value)
        assert torch.equal(rest.labels.costate, plain.labels.costate.flip(-2))
        assert torch.equal(rest.labels.players, plain.labels.players.flip(-1))
        again = branch_of(game, found.x.flip(2), axes).repeat_interleave(len(found.t))
        assert torch.equal(rest.types.branch, again)


def test_the_best_of_every_start_has_the_largest_potential() -> None:
    game = make("narrow_road")
    found = fake_labels(game, count=6)._replace(start=torch.tensor([0, 0, 1, 1, 1, 4]))
    best = best_equilibria(found)
    for start in (0, 1, 4):
        rows = (found.start == start).nonzero().squeeze(-1)
        assert best[rows].sum() == 1
        assert found.potential[rows, 0].argmax() == best[rows].int().argmax()


def test_labels_without_a_potential_are_refused() -> None:
    game = make("narrow_road")
    found = fake_labels(game)
    with pytest.raises(ValueError, match=r"without a potential.*function=value"):
        potential_rows(game, [found._replace(potential=found.potential * torch.nan)], torch.zeros(1, 3).double())
