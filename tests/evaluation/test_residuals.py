"""The HJI residual by region, on value functions whose residual is known."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from hno.evaluation.residuals import REGIONS, ResidualRow, Residuals, hji, residual_table
from hno.games import Game, make
from hno.losses import Scales, View
from hno.losses.hji import HJIResidual
from hno.operators import ValueOperator, make_operator
from hno.types import Field, Points, Sample, Status, Types
from tests.fakes import fake_labels, small_architecture
from tests.lq import LinearQuadratic

AB, RQS = (0.4, 1.3), (0.7, 1.1, 0.9)


def one_player() -> LinearQuadratic:
    """x' = a x + b u at a cost of q x^2 + r u^2, and s x^2 at the end."""
    (a, b), (r, q, s) = ([torch.full((1, 1, 1), c) for c in constants] for constants in (AB, RQS))
    return LinearQuadratic(a, b, r[..., 0], q, s)


def riccati(error: Callable[[Tensor], tuple[Tensor, Tensor]]) -> ValueOperator:
    """Its exact value -p(tau) x^2 plus an error that depends on time to go alone, given with its derivative."""
    (a, b), (r, q, s) = AB, RQS
    curve = solve_ivp(lambda t, p: q + 2 * a * p - b**2 * p**2 / r, (0, 1), [s], rtol=1e-10, dense_output=True).sol

    def field(points: Points) -> Field:
        p = torch.from_numpy(curve(points.tau.numpy())[0]).float().unsqueeze(-1)
        x = points.x[..., 0]
        more, slope = error(points.tau.unsqueeze(-1))
        rate = q + 2 * a * p - b**2 * p**2 / r
        return Field(-p * x**2 + more, -rate * x**2 + slope, (-2 * p * x)[..., None, None])

    scales = Scales(torch.tensor(2.0), torch.ones(1, 1, 1))
    game = one_player()
    fake: Any = SimpleNamespace(game=game, problem=game, field=field, scales=scales)
    fake.view = functools.partial(ValueOperator.view, fake)
    return fake


def table(operator: ValueOperator, **options: int) -> list[ResidualRow]:
    labels = [fake_labels(operator.game, (0.5,), 6), fake_labels(operator.game, (0.25,), 6)]
    return residual_table(operator, labels, [(0.5,)], **{"points": 256, **options})


def test_an_exact_value_has_no_residual_anywhere() -> None:
    rows = table(riccati(lambda tau: (torch.zeros_like(tau), torch.zeros_like(tau))))
    assert [(row.theta, row.seen, row.region) for row in rows] == [
        (theta, theta == (0.5,), region) for theta in ((0.5,), (0.25,)) for region in REGIONS
    ]
    assert all(row.physical is not None and row.physical < 1e-4 for row in rows)


def test_an_error_of_the_time_derivative_is_the_residual() -> None:
    rows = table(riccati(lambda tau: (-3 * tau, torch.full_like(tau, -3.0))))
    assert all(row.physical == pytest.approx(3, rel=1e-4) for row in rows)


def test_bins_are_of_time_to_go() -> None:
    """A residual of tau itself averages to the middle of each bin, up to chance; starts lie at the very beginning."""
    rows = table(riccati(lambda tau: (tau**2 / 2, tau)), points=4096)
    by_region = dict(zip(REGIONS, rows, strict=False))
    for region in ("PDE box", "constraint band"):
        assert by_region[region].tau == (0, 0.25, 0.5, 0.75, 1)
        assert by_region[region].physical_by_tau == pytest.approx((0.125, 0.375, 0.625, 0.875), abs=0.02)
    assert by_region["start box"].points_by_tau == (0, 0, 0, 4096)
    assert by_region["start box"].physical_by_tau == (None, None, None, pytest.approx(1, rel=1e-4))
    assert by_region["along labels"].points_by_tau == (18, 12, 18, 18)
    assert by_region["along labels"].physical_by_tau[1] == pytest.approx((0.3 + 0.4) / 2, rel=1e-3)


@pytest.fixture
def operator() -> ValueOperator:
    torch.manual_seed(0)
    built = make_operator(make("narrow_road"), small_architecture()).eval().requires_grad_(False)
    built.set_scales(Scales(torch.tensor(20.0), torch.ones(2, 2, 4)))
    return built


SEEN = [(1.0, 1.0)]


def test_means_are_those_of_the_loss_term(operator: ValueOperator) -> None:
    game, found = operator.game, fake_labels(make("narrow_road"), (2.0, 3.0), 5)
    row = residual_table(operator, [found], [])[-1]
    nodes = len(found.t)
    points = Points(
        (game.horizon - found.t).float().repeat(5),
        found.x.flatten(0, 1).float(),
        torch.tensor([[2.0, 3.0]] * 5 * nodes),
    )
    view = View(game, game, Sample(points), operator.field(points), operator.field, operator.scales, 0)
    residual, scale = HJIResidual().residual(view), HJIResidual().scale(view)
    assert row.points == 5 * nodes
    assert row.physical == pytest.approx(residual.abs().mean().item(), rel=1e-5)
    assert row.scaled == pytest.approx((residual / scale).abs().mean().item(), rel=1e-5)
    assert all(torch.equal(*pair) for pair in zip(hji(operator, points), (residual, scale), strict=True))


def test_bins_make_up_the_whole(operator: ValueOperator) -> None:
    for row in residual_table(operator, [fake_labels(operator.game, (2.0, 3.0), 5)], [], points=500, bins=3):
        assert sum(row.points_by_tau) == row.points
        for whole, parts in ((row.physical, row.physical_by_tau), (row.scaled, row.scaled_by_tau)):
            total = sum((part or 0) * count for part, count in zip(parts, row.points_by_tau, strict=True))
            assert total / row.points == pytest.approx(whole, rel=1e-9)


def test_points_lie_in_their_regions(operator: ValueOperator, monkeypatch: pytest.MonkeyPatch) -> None:
    game, asked = operator.game, list[Points]()
    original = operator.field

    def field(points: Points, types: Types | None = None) -> Field:
        asked.append(points)
        return original(points)

    monkeypatch.setattr(operator, "field", field)
    residual_table(operator, [fake_labels(game, (2.0, 3.0), 5)], [], points=2000)
    start, box, band, around, along = asked
    assert bool(game.initial_box.contains(start.x).all())
    assert bool((start.tau == game.horizon).all())
    assert bool(game.state_box.contains(box.x).all())
    near = [float((game.constraint(p.x, p.theta).amax((-2, -1)).abs() < 1.6).float().mean()) for p in (box, band)]
    assert near[1] > 0.5 > 5 * near[0]
    closest = (around.x[:200].flatten(1).unsqueeze(1) - along.x.flatten(1)).abs() / game.state_box.width.flatten()
    assert float(closest.square().mean(-1).sqrt().amin(-1).median()) < 0.07
    assert all(bool((p.theta == torch.tensor([2.0, 3.0])).all()) for p in asked)


def test_rows_depend_on_the_seed_and_not_on_other_types(operator: ValueOperator) -> None:
    sets = [fake_labels(operator.game, theta, 4) for theta in ((1.0, 1.0), (4.0, 2.0))]
    both = residual_table(operator, sets, [], points=64, seed=3)
    assert both[len(REGIONS) :] == residual_table(operator, sets[1:], [], points=64, seed=3)
    other = residual_table(operator, sets, [], points=64, seed=4)
    changed = [one.physical != two.physical for one, two in zip(both, other, strict=True)]
    assert changed == [True, True, True, True, False] * 2


def test_labels_of_which_none_converged_are_no_region(operator: ValueOperator) -> None:
    found = fake_labels(operator.game, (1.0, 1.0), 3, status=[Status.STALLED] * 3)
    rows = residual_table(operator, [found], [], points=16)
    assert [row.points for row in rows] == [16, 16, 16, 0, 0]
    for row in rows[3:]:
        assert (row.physical, row.scaled) == (None, None)
        assert row.physical_by_tau == row.scaled_by_tau == (None,) * 4


def test_only_converged_labels_are_looked_at(operator: ValueOperator) -> None:
    found = fake_labels(operator.game, (1.0, 1.0), 3)
    broken = found._replace(x=found.x.clone(), status=torch.tensor([0, int(Status.NOT_FINITE), 0]))
    broken.x[1] = math.nan
    row = residual_table(operator, [broken], [], points=16)[-1]
    assert row.points == 2 * len(found.t)
    assert row.physical is not None


def test_the_game_stays_as_it_is(operator: ValueOperator) -> None:
    before: Game = make("narrow_road")
    residual_table(operator, [fake_labels(operator.game, (1.0, 1.0), 2)], [], points=16)
    assert operator.game.fingerprint() == before.fingerprint()


def test_means_over_types_are_those_over_their_points() -> None:
    """A residual of tau itself: weights are points, region by region and bin by bin."""
    rows = table(riccati(lambda tau: (tau**2 / 2, tau)))
    shown = Residuals().rows([row._asdict() for row in rows])
    assert [(row["region"], row["types"]) for row in shown] == [
        (region, f"1 {kind}") for region in REGIONS for kind in ("seen", "unseen")
    ]
    unseen = [row._replace(seen=False, points=3 * row.points, physical=5.0) for row in rows[: len(REGIONS)]]
    pooled = Residuals().rows([row._asdict() for row in (*unseen, *rows[len(REGIONS) :])])
    for one, other, both in zip(unseen, rows[len(REGIONS) :], pooled, strict=True):
        assert (both["types"], both["points"]) == ("2 unseen", one.points + other.points)
        assert both["physical"] == pytest.approx((3 * 5.0 + other.physical) / 4)
        for place, mean in enumerate(both["scaled_by_tau"]):
            assert (
                mean == pytest.approx(other.scaled_by_tau[place], rel=0.2) if other.points_by_tau[place] else not mean
            )
