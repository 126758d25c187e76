"""An operator of several members: their median, each trained along the gradient that it would have alone."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from hno.operators import ValueOperator
from hno.training.checkpoint import Provenance, load_operator, record
from hno.training.saving import seal
from hno.types import Batch, Field, Labels, Points, Sample
from tests.operators.conftest import GAMES, MakeModule, MakeOperator, architecture, module_of, random_points


def alone(make_operator: MakeOperator, network: nn.Module, game: str = "narrow_road", **options: Any) -> ValueOperator:
    """The operator of one member."""
    single = make_operator(game, **options).double()
    single.networks[0].load_state_dict(network.state_dict())
    return single


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
    singles = [alone(make_operator, net, game, exact_terminal=exact) for net in operator.networks]
    fields = [single.field(points) for single in singles]
    for part, members in zip(operator.field(points), zip(*fields, strict=True), strict=True):
        torch.testing.assert_close(part, torch.stack(members).median(0).values)
    values = torch.stack([single(*points) for single in singles])
    torch.testing.assert_close(operator(*points), values.median(0).values)
    assert all(bool((a != b).any()) for a, b in itertools.pairwise(values))


def test_one_member_that_errs_changes_little(make_operator: MakeOperator) -> None:
    operator = make_operator(members=3)
    points = random_points(operator.game, 50)
    _, *others = (alone(make_operator, net).float().field(points) for net in operator.networks)
    with torch.no_grad():
        for weights in operator.networks[0].parameters():
            weights.mul_(100)
    for part, pair in zip(operator.field(points), zip(*others, strict=True), strict=True):
        low, high = torch.stack(pair).aminmax(dim=0)
        assert bool(((part >= low) & (part <= high)).all())


@pytest.mark.parametrize("method", ["hno", "sno"])
def test_every_member_is_trained_along_the_gradient_that_it_would_have_alone(
    make_module: MakeModule, make_operator: MakeOperator, method: str
) -> None:
    module = make_module("lane_change", method, members=3).double()
    points = Points(*(part.double() for part in random_points(module.operator.game, 12)))
    end = Sample(points._replace(tau=torch.zeros_like(points.tau)))
    batch: Batch = {"bvp": labelled(points), "interior": Sample(points), "terminal": end}
    module.training_step(batch, 0).backward()
    for network in module.operator.networks:
        single = module_of(alone(make_operator, network, "lane_change"), method)
        single.training_step(batch, 0).backward()
        for mine, own in zip(network.parameters(), single.operator.parameters(), strict=True):
            assert mine.grad is not None
            torch.testing.assert_close(3 * mine.grad, own.grad)


def test_the_first_member_starts_where_a_single_net_starts(make_operator: MakeOperator) -> None:
    first, single = make_operator(members=3).networks[0], make_operator().networks[0]
    assert all(map(torch.equal, first.parameters(), single.parameters()))


def test_a_checkpoint_keeps_every_member(make_operator: MakeOperator, tmp_path: Path) -> None:
    operator = make_operator("drone", members=3)
    weights = {f"operator.{name}": weight for name, weight in operator.state_dict().items()}
    entries = record(operator.game, architecture(members=3), Provenance())
    (tmp_path / "last.ckpt").write_bytes(seal(entries | {"state_dict": weights}))
    points = random_points(operator.game)
    loaded: Field = load_operator(tmp_path / "last.ckpt")[0].field(points)
    assert all(map(torch.equal, loaded, operator.field(points)))


@pytest.mark.parametrize("members", [0, 2, -1, 1.0, True, None, "three"])
def test_an_ensemble_needs_a_median(make_operator: MakeOperator, members: object) -> None:
    with pytest.raises(
        ValueError, match=rf"function.members must be an odd whole number, such as 1 or 3.*got {members!r}\."
    ):
        make_operator(members=members)
