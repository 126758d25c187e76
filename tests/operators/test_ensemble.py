"""An operator of several members: their median, each trained along the gradient that it would have alone."""

from __future__ import annotations

import copy
import itertools
from pathlib import Path
from typing import Any

import pytest
import torch

from hno.operators import ValueOperator
from hno.operators.deeponet import DeepONet, nets
from hno.training.checkpoint import load_operator
from hno.types import Batch, Field, Labels, Points, Sample
from tests.operators.conftest import GAMES, MakeOperator, random_points


def alone(make_operator: MakeOperator, net: DeepONet, game: str = "narrow_road", **options: Any) -> ValueOperator:
    """The operator of one member."""
    single = make_operator(game, **options).double()
    single.net = copy.deepcopy(net)
    silence(single)
    return single


def silence(operator: ValueOperator) -> None:
    """Let it log nothing: there is no trainer to log to."""
    operator.log_dict = operator.log = lambda *_, **__: None  # type: ignore[assignment, method-assign]


def labelled(points: Points) -> Sample:
    """Rows with arbitrary labels."""
    rows, players, states = points.x.shape
    generator = torch.Generator().manual_seed(1)
    costate = torch.randn(rows, players, players, states, generator=generator, dtype=torch.float64)
    return Sample(points, Labels(40 * torch.randn(rows, players, generator=generator, dtype=torch.float64), costate))


@pytest.mark.parametrize("game", GAMES)
@pytest.mark.parametrize("exact", [False, True])
def test_the_operator_is_the_median_of_its_members(make_operator: MakeOperator, game: str, exact: bool) -> None:
    operator = make_operator(game, members=3, exact_terminal=exact).double()
    points = Points(*(part.double() for part in random_points(operator.game, 9)))
    singles = [alone(make_operator, net, game, exact_terminal=exact) for net in nets(operator.net)]
    fields = [single.field(points) for single in singles]
    for part, members in zip(operator.field(points), zip(*fields, strict=True), strict=True):
        torch.testing.assert_close(part, torch.stack(members).median(0).values)
    values = torch.stack([single(*points) for single in singles])
    torch.testing.assert_close(operator(*points), values.median(0).values)
    assert all(bool((a != b).any()) for a, b in itertools.pairwise(values))


def test_one_member_that_errs_changes_little(make_operator: MakeOperator) -> None:
    operator = make_operator(members=3)
    points = random_points(operator.game, 50)
    _, *others = (alone(make_operator, net).float().field(points) for net in nets(operator.net))
    with torch.no_grad():
        for weights in nets(operator.net)[0].parameters():
            weights.mul_(100)
    for part, pair in zip(operator.field(points), zip(*others, strict=True), strict=True):
        low, high = torch.stack(pair).aminmax(dim=0)
        assert bool(((part >= low) & (part <= high)).all())


@pytest.mark.parametrize("name", ["hno", "sno"])
def test_every_member_is_trained_along_the_gradient_that_it_would_have_alone(
    make_operator: MakeOperator, name: str
) -> None:
    operator = make_operator("lane_change", name, members=3).double()
    silence(operator)
    points = Points(*(part.double() for part in random_points(operator.game, 12)))
    end = Sample(points._replace(tau=torch.zeros_like(points.tau)))
    batch: Batch = {"bvp": labelled(points), "interior": Sample(points), "terminal": end}
    operator.training_step(batch, 0).backward()
    for net in nets(operator.net):
        single = alone(make_operator, net, "lane_change", name=name)
        single.zero_grad()
        single.training_step(batch, 0).backward()
        for mine, own in zip(net.parameters(), single.net.parameters(), strict=True):
            assert mine.grad is not None
            torch.testing.assert_close(3 * mine.grad, own.grad)


def test_the_first_member_starts_where_a_single_net_starts(make_operator: MakeOperator) -> None:
    first, single = nets(make_operator(members=3).net)[0], make_operator().net
    assert all(map(torch.equal, first.parameters(), single.parameters()))


def test_a_checkpoint_keeps_every_member(make_operator: MakeOperator, tmp_path: Path) -> None:
    operator = make_operator("drone", members=3)
    saved = {"state_dict": operator.state_dict()}
    operator.on_save_checkpoint(saved)
    torch.save(saved, tmp_path / "last.ckpt")
    points = random_points(operator.game)
    loaded: Field = load_operator(tmp_path / "last.ckpt").field(points)
    assert all(map(torch.equal, loaded, operator.field(points)))


@pytest.mark.parametrize("members", [0, 2, -1, 1.0, True, None, "three"])
def test_an_ensemble_needs_a_median(make_operator: MakeOperator, members: object) -> None:
    with pytest.raises(
        ValueError, match=rf"operator.members must be an odd whole number, such as 1 or 3.*got {members!r}\."
    ):
        make_operator(members=members)
