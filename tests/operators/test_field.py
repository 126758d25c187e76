from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from copy import deepcopy
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from hno.operators.inputs import distinct_types, ego_views
from hno.training.checkpoint import CheckpointError, Provenance, check_resumable, load_operator, record
from hno.training.saving import seal
from hno.types import Field, Labels, Points, Sample, Types, tables
from tests.operators.conftest import ACTIVATIONS, GAMES, MakeOperator, architecture, random_points


@pytest.mark.parametrize("game", GAMES)
@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("exact", [False, True])
def test_field_is_the_jacobian_of_forward_in_physical_units(
    make_operator: MakeOperator, game: str, activation: str, exact: bool
) -> None:
    operator = make_operator(game, activation=activation, exact_terminal=exact).double()
    points = random_points(operator.game, 4)
    field = operator.field(points)

    def value(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        return operator(tau.unsqueeze(0), x.unsqueeze(0), theta.unsqueeze(0)).squeeze(0)

    for row, at in enumerate(zip(*points, strict=True)):
        in_time, in_state = torch.func.jacrev(value, argnums=(0, 1))(*at)
        torch.testing.assert_close(field.value[row], value(*at))
        torch.testing.assert_close(field.dvalue_dtau[row], in_time)
        torch.testing.assert_close(field.costate[row], in_state)


@pytest.mark.parametrize("exact", [False, True])
def test_field_agrees_with_finite_differences(make_operator: MakeOperator, exact: bool) -> None:
    operator = make_operator("lane_change", exact_terminal=exact).double()
    tau, x, theta = random_points(operator.game, 3)
    field, step = operator.field(Points(tau, x, theta)), 1e-6
    for player in range(2):
        for state in range(4):
            moved = torch.zeros_like(x)
            moved[:, player, state] = step
            slope = (operator(tau, x + moved, theta) - operator(tau, x - moved, theta)) / (2 * step)
            torch.testing.assert_close(field.costate[:, :, player, state], slope, rtol=1e-5, atol=1e-6)
    slope = (operator(tau + step, x, theta) - operator(tau - step, x, theta)) / (2 * step)
    torch.testing.assert_close(field.dvalue_dtau, slope, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("game", GAMES)
def test_field_of_a_batch_is_the_field_of_its_rows(make_operator: MakeOperator, game: str) -> None:
    operator = make_operator(game).double()
    points = random_points(operator.game, 7, types=3)
    whole = operator.field(points)
    rows = [operator.field(Points(*(part[row : row + 1] for part in points))) for row in range(7)]
    for part, single in zip(whole, Field(*map(torch.cat, zip(*rows, strict=True))), strict=True):
        torch.testing.assert_close(part, single, rtol=1e-12, atol=1e-12)


def test_the_order_of_rows_does_not_matter(make_operator: MakeOperator) -> None:
    operator = make_operator().double()
    points, order = random_points(operator.game, 8, types=4), torch.tensor([5, 0, 7, 2, 1, 6, 4, 3])
    shuffled = operator.field(Points(*(part[order] for part in points)))
    for part, other in zip(operator.field(points), shuffled, strict=True):
        torch.testing.assert_close(part[order], other, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("game", GAMES)
def test_the_boundary_condition_can_hold_exactly(make_operator: MakeOperator, game: str) -> None:
    """V = -g + (tau / horizon) N: value and costate at the end are those of the game, whatever the weights."""
    operator = make_operator(game, exact_terminal=True)
    points = random_points(operator.game, 20)
    end = points._replace(tau=torch.zeros_like(points.tau))
    x = end.x.double().requires_grad_()
    value = deepcopy(operator.game).double().terminal_value(x)
    costate = torch.stack([torch.autograd.grad(value[:, i].sum(), x, retain_graph=True)[0] for i in range(2)], 1)
    for field in (operator.field(end), operator.field(end, distinct_types(end.theta))):
        assert torch.equal(field.value, operator.game.terminal_value(end.x))
        torch.testing.assert_close(field.costate, costate.float(), rtol=1e-6, atol=1e-6 * float(costate.abs().max()))
        assert not field.costate[:, [0, 1], [1, 0]].any(), "no player is paid for where the other one ends"
    assert torch.equal(operator(*end), operator.game.terminal_value(end.x))
    assert not torch.allclose(operator.field(points).value, operator.game.terminal_value(points.x), rtol=1e-3)


@pytest.mark.parametrize("game", GAMES)
def test_an_exact_end_leaves_the_rest_to_the_net(make_operator: MakeOperator, game: str) -> None:
    """At the beginning the net itself adds to the terminal value."""
    exact, free = make_operator(game, exact_terminal=True).double(), make_operator(game).double()
    points = random_points(exact.game)
    start = points._replace(tau=torch.full_like(points.tau, exact.game.horizon))
    ours, net = exact.field(start), free.field(start)
    torch.testing.assert_close(ours.value, exact.game.terminal_value(start.x) + net.value)
    torch.testing.assert_close(ours.dvalue_dtau, net.value / exact.game.horizon + net.dvalue_dtau)


def test_an_exact_end_travels_with_the_checkpoint(make_operator: MakeOperator, tmp_path: Path) -> None:
    operator = make_operator("lane_change", exact_terminal=True)
    content = record(operator.game, architecture(exact_terminal=True), Provenance())
    weights = {f"operator.{name}": weight for name, weight in operator.state_dict().items()}
    (tmp_path / "last.ckpt").write_bytes(seal(content | {"state_dict": weights}))
    points = random_points(operator.game)
    with torch.no_grad():
        expected = operator.field(points)
    assert all(map(torch.equal, load_operator(tmp_path / "last.ckpt")[0].field(points), expected))
    with pytest.raises(CheckpointError, match="exact_terminal"):
        check_resumable(tmp_path / "last.ckpt", record(operator.game, architecture(), Provenance()))


@pytest.mark.parametrize("quiet", [torch.no_grad, torch.inference_mode])
def test_an_exact_end_needs_no_gradients_from_outside(
    make_operator: MakeOperator, quiet: Callable[[], AbstractContextManager[None]]
) -> None:
    operator = make_operator("drone", exact_terminal=True)
    points = random_points(operator.game)
    with quiet():
        inside = operator.field(Points(*(part.clone() for part in points)))
    assert not any(part.requires_grad for part in inside)
    assert all(map(torch.equal, inside, operator.field(points)))


@pytest.mark.parametrize("game", GAMES)
@pytest.mark.parametrize("exact", [False, True])
def test_a_table_of_types_changes_nothing(make_operator: MakeOperator, game: str, exact: bool) -> None:
    operator = make_operator(game, exact_terminal=exact).double()
    points = random_points(operator.game, 10, types=4)
    found = operator.field(points)
    spare = operator.game.type_box.sample(2, torch.Generator().manual_seed(9)).double()
    searched = distinct_types(points.theta)
    for table in (
        searched,
        Types(points.theta, torch.arange(10)),
        Types(torch.cat([spare, searched.distinct]), searched.which + 2),
        Types(searched.distinct.flip(0), 3 - searched.which),
    ):
        assert torch.equal(table.distinct[table.which], points.theta)
        for part, other in zip(operator.field(points, table), found, strict=True):
            torch.testing.assert_close(part, other, rtol=1e-12, atol=1e-12)


def test_a_table_is_believed(make_operator: MakeOperator) -> None:
    """A field that looked the types up again would not notice a wrong table."""
    operator = make_operator().double()
    points = random_points(operator.game, 6, types=3)
    searched = distinct_types(points.theta)
    other = searched._replace(which=searched.which.roll(1))
    moved = points._replace(theta=searched.distinct[other.which])
    assert all(map(torch.equal, operator.field(points, other), operator.field(moved, distinct_types(moved.theta))))
    assert not torch.allclose(operator.field(points, other).value, operator.field(points).value, rtol=1e-6)


def test_tables_are_joined_one_after_the_other() -> None:
    parts = [
        Types(torch.tensor([[1.0, 2.0], [3.0, 4.0]]), torch.tensor([1, 0, 1])),
        Types(torch.tensor([[5.0, 6.0]]), torch.tensor([0, 0])),
        Types(torch.tensor([[1.0, 2.0], [7.0, 8.0], [9.0, 9.0]]), torch.tensor([2, 1, 0, 0])),
    ]
    joined = tables(parts)
    expected = torch.cat([part.distinct[part.which] for part in parts])
    assert torch.equal(joined.distinct[joined.which], expected)
    assert joined.which.tolist() == [1, 0, 1, 2, 2, 5, 4, 3, 3]
    assert all(map(torch.equal, tables(parts[:1])[:2], parts[0][:2]))


@pytest.mark.parametrize("index", [torch.tensor([4, 0, 0]), torch.tensor([True, False, True, False, False, True])])
@pytest.mark.parametrize("parts", ["labels", "types", "both", "neither"])
def test_rows_of_a_sample_stay_together(make_operator: MakeOperator, index: Tensor, parts: str) -> None:
    points = random_points(make_operator().game, 6, types=3)
    labels = Labels(torch.randn(6, 2), torch.randn(6, 2, 2, 4)) if parts in ("labels", "both") else None
    types = distinct_types(points.theta) if parts in ("types", "both") else None
    sample = Sample(points, labels, types)
    picked = sample.rows(index)
    assert (sample.size, picked.size) == (6, 3)
    assert all(torch.equal(part, whole[index]) for part, whole in zip(picked.points, points, strict=True))
    assert (picked.labels is None, picked.types is None) == (labels is None, types is None)
    if labels is not None:
        assert all(torch.equal(part, whole[index]) for part, whole in zip(picked.labels, labels, strict=True))
    if types is not None:
        assert torch.equal(picked.types.distinct[picked.types.which], picked.points.theta)


def swapped(points: Points) -> Points:
    return Points(points.tau, points.x.flip(-2), points.theta.flip(-1))


@pytest.mark.parametrize("game", ["narrow_road", "drone"])
def test_swapping_players_swaps_values_and_costates(make_operator: MakeOperator, game: str) -> None:
    operator = make_operator(game).double()
    points = random_points(operator.game)
    here, there = operator.field(points), operator.field(swapped(points))
    torch.testing.assert_close(there.value, here.value.flip(-1))
    torch.testing.assert_close(there.dvalue_dtau, here.dvalue_dtau.flip(-1))
    torch.testing.assert_close(there.costate, here.costate.flip(-3, -2))
    assert not torch.allclose(here.value, here.value.flip(-1))


def test_players_of_different_roles_do_not_swap(make_operator: MakeOperator) -> None:
    operator = make_operator("lane_change").double()
    points = random_points(operator.game)
    assert not torch.allclose(operator.field(swapped(points)).value, operator.field(points).value.flip(-1), rtol=1e-3)


def test_value_depends_on_the_types(make_operator: MakeOperator) -> None:
    operator = make_operator()
    tau, x, _ = random_points(operator.game)
    small, large = (operator(tau, x, torch.full((6, 2), theta)) for theta in (1.0, 5.0))
    assert not torch.allclose(small, large, rtol=1e-3)


def inputs_of(net: nn.Module, seen: list[Tensor]) -> None:
    net.register_forward_pre_hook(lambda module, arguments: seen.append(arguments[0].detach().clone()))


@pytest.mark.parametrize("types", [1, 3, 12])
def test_branch_runs_once_per_distinct_theta(make_operator: MakeOperator, types: int) -> None:
    operator, seen = make_operator(), []
    inputs_of(operator.networks[0].branch, seen)
    points = random_points(operator.game, 12, types=types)
    operator.field(points)
    assert [len(inputs) for inputs in seen] == [types * operator.game.players]


def test_branch_sees_the_sensors_of_each_row(make_operator: MakeOperator) -> None:
    operator, sensors, rows = make_operator(), [], []
    inputs_of(operator.networks[0].branch, sensors)
    operator.networks[0].register_forward_pre_hook(lambda module, arguments: rows.append(arguments[2]))
    points = random_points(operator.game, 10, types=4)
    operator(*points)
    fed = sensors[0][rows[0]].unflatten(0, (10, 2))
    assert torch.equal(fed, operator.game.sensors(points.theta))


@pytest.mark.parametrize("game", GAMES)
def test_state_box_and_horizon_map_to_the_unit_box_exactly(make_operator: MakeOperator, game: str) -> None:
    operator, seen = make_operator(game), []
    inputs_of(operator.networks[0].trunk, seen)
    box, size = operator.game.state_box, operator.game.players * operator.game.state_dim
    tau = torch.tensor([0.0, operator.game.horizon])
    operator(tau, torch.stack([box.lo, box.hi]), torch.ones(2, 2))
    assert torch.equal(seen[0][:, : 1 + size], torch.tensor([[-1.0], [-1.0], [1.0], [1.0]]).expand(4, 1 + size))
    torch.testing.assert_close(box.scale((box.lo + box.hi) / 2), torch.zeros_like(box.lo), rtol=0, atol=1e-6)


def test_role_is_an_input_only_where_players_differ(make_operator: MakeOperator) -> None:
    seen: dict[str, list[Tensor]] = {}
    for game in GAMES:
        operator = make_operator(game)
        inputs_of(operator.networks[0].trunk, seen.setdefault(game, []))
        operator(*random_points(operator.game, 3))
    widths = {game: inputs[0].shape[-1] for game, inputs in seen.items()}
    assert widths == {"narrow_road": 9, "lane_change": 10, "drone": 13}
    assert torch.equal(seen["lane_change"][0][:, -1], torch.tensor([0.0, 1.0]).repeat(3))


def test_ego_views_put_each_player_first_and_invert() -> None:
    x = torch.arange(2 * 3 * 4.0).view(2, 3, 4)
    views = ego_views(x)
    for player in range(3):
        assert torch.equal(views[:, player, 0], x[:, player])
        assert torch.equal(views[:, player, 1], x[:, (player + 1) % 3])
    assert torch.equal(ego_views(views, inverse=True), x.unsqueeze(-3).expand(2, 3, 3, 4))


def test_field_works_where_gradients_are_switched_off(make_operator: MakeOperator) -> None:
    operator = make_operator()
    points = random_points(operator.game)
    with torch.no_grad():
        quiet = operator.field(points)
    assert all(map(torch.equal, quiet, operator.field(points)))
    assert not any(part.requires_grad for part in quiet)


def test_field_is_differentiable_in_the_weights_on_request(make_operator: MakeOperator) -> None:
    operator = make_operator()
    field = operator.field(random_points(operator.game))
    weight = operator.networks[0].trunk.layers[0].weight
    for part in field:
        (slope,) = torch.autograd.grad(part.square().sum(), weight, retain_graph=True)
        assert bool(slope.any())


def test_value_scale_multiplies_the_field(make_operator: MakeOperator) -> None:
    operator = make_operator()
    points = random_points(operator.game)
    before = operator.field(points)
    operator.value_scale.mul_(2)
    for old, new in zip(before, operator.field(points), strict=True):
        torch.testing.assert_close(new, 2 * old)
