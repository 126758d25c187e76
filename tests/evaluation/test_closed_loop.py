from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence

import pytest
import torch
from torch import Tensor

from hno.cli.sections import show
from hno.control import Feedback
from hno.control.rollout import Disturbance, rollout
from hno.data.rows import rows_of
from hno.evaluation import metrics
from hno.evaluation.closed_loop import CollisionTable, TypeRow, label_errors, play, verdict
from hno.evaluation.metrics import in_batches
from hno.evaluation.residuals import hji
from hno.games import make
from hno.games.base import own_costate
from hno.types import Extremal, Field, Points, PotentialField, Status
from tests.fakes import fake_labels, played_table
from tests.operators.conftest import small_operator
from tests.walkers import Walkers

GOOD, BAD = Status.CONVERGED, Status.STALLED


def straight(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
    """Walk along x at 4 m/s: walkers who start at the same height miss each other by twice that."""
    return torch.tensor([4.0, 0.0]).expand(len(x), 2, 2)


def starts(heights: Sequence[float]) -> Tensor:
    return torch.tensor([[[0.0, y], [0.0, y]] for y in heights])


def labelled(
    heights: Sequence[float], clearance: Sequence[float], status: Sequence[Status] | None = None, theta: float = 1.0
) -> Extremal:
    count = len(heights)
    return fake_labels(Walkers(), (theta, theta), count, 0, status, clearance, starts(heights))


RESULTS = {"clearance": 0.02, "constraint_unit": "m"}


def remarks(rows: Sequence[TypeRow]) -> list[str]:
    """Below the table, without the totals."""
    return CollisionTable().remarks([row.content() for row in rows], RESULTS)[1:]


def test_every_start_is_of_one_kind_and_marginal_ones_are_apart() -> None:
    clearances = [0.5, 0.5, 0.01, 0.01, -0.2, 0.5]
    heights = [0.05, 0.9, 0.05, 0.9, 0.05, 0.05]
    labels = labelled(heights, clearances, [GOOD] * 5 + [BAD])
    (row,) = played_table(Walkers(), straight, [labels], seen=[])
    assert (
        row.outcome.starts,
        row.outcome.unsolved,
        row.outcome.inevitable,
        row.outcome.marginal,
        row.outcome.safe_starts,
    ) == (6, 1, 1, 2, 2)
    assert (
        row.outcome.unsolved + row.outcome.inevitable + row.outcome.marginal + row.outcome.safe_starts
        == row.outcome.starts
    )
    assert (row.outcome.collisions, row.outcome.marginal_collisions) == (1, 1)
    assert row.outcome.rate == 0.5
    assert row.outcome.interval == pytest.approx((0.012579, 0.987421), abs=1e-6)


def test_medians_are_over_safe_starts_and_compare_with_the_label() -> None:
    heights = [0.5, 0.6, 0.7, 0.05]
    found = labelled(heights, [0.5, 0.5, 0.5, -1.0])
    (row,) = played_table(Walkers(), straight, [found], seen=[])
    assert row.outcome.median_min_distance == pytest.approx(1.2, abs=1e-3)
    label_cost = -found.value[:3, 0].sum(-1)
    assert row.outcome.median_label_cost == pytest.approx(label_cost.median().item())
    again = played_table(Walkers(), straight, [found._replace(value=found.value - 50)], seen=[])
    assert row.outcome.median_excess_cost is not None
    assert again[0].outcome.median_excess_cost == pytest.approx(row.outcome.median_excess_cost - 100, rel=1e-6)


def test_rows_keep_their_type_and_order() -> None:
    sets = [labelled([0.9] * n, [0.5] * n, theta=theta) for n, theta in ((3, 1.0), (1, 4.0), (2, 0.5))]
    rows = played_table(Walkers(), straight, sets, seen=[(4.0, 4.0)])
    assert [row.theta for row in rows] == [(1.0, 1.0), (4.0, 4.0), (0.5, 0.5)]
    assert [row.outcome.starts for row in rows] == [3, 1, 2]
    assert [row.seen for row in rows] == [False, True, False]


def test_episodes_are_the_same_however_many_are_played_together() -> None:
    sets = [labelled([0.05, 0.3, 0.9][:n], [0.5] * n, theta=theta) for n, theta in ((3, 1.0), (2, 4.0), (1, 0.5))]
    together = list(play(Walkers(), straight, sets, 0.02))
    for most in (1, 3, 5):
        for (label, paths), (same, other) in zip(
            together, play(Walkers(), straight, sets, 0.02, at_once=most), strict=True
        ):
            assert label is same
            assert all(map(torch.equal, paths, other))


def test_only_the_labels_of_what_is_played_together_are_read() -> None:
    read = list[int]()

    def sets() -> Iterator[Extremal]:
        for number in range(5):
            read.append(number)
            yield labelled([0.9] * 3, [0.5] * 3)

    playing = play(Walkers(), straight, sets(), 0.02, at_once=6)
    next(playing)
    assert read == [0, 1, 2]  # the third one does not fit


def test_errors_and_residuals_are_the_same_in_small_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    operator, found = small_operator(), fake_labels(make("narrow_road"), (2.0, 3.0), 3)
    points = rows_of(operator.game, [found]).points
    errors, residuals = label_errors(Feedback(operator), found), hji(operator, points)
    monkeypatch.setattr(metrics, "BATCH", 10)
    assert label_errors(Feedback(operator), found) == pytest.approx(errors, rel=1e-5)
    for whole, parts in zip(residuals, in_batches(functools.partial(hji, operator), points), strict=True):
        torch.testing.assert_close(whole, parts, rtol=1e-4, atol=1e-4)


def test_collision_radius_is_that_of_the_rows_type() -> None:
    """Walkers miss each other by 0.6 m; the radius is 0.2 + 0.2 theta."""
    sets = [labelled([0.3], [0.5], theta=theta) for theta in (1.0, 4.0, 1.5)]
    rows = played_table(Walkers(), straight, sets, seen=[])
    assert [row.outcome.collisions for row in rows] == [0, 1, 0]


def test_a_broken_policy_collides_everywhere() -> None:
    found = labelled([0.9, 0.9], [0.5, 0.01])
    nothing = torch.full((2, 2), torch.nan)
    (row,) = played_table(Walkers(), lambda tau, x, theta: nothing.expand(len(x), 2, 2), [found], seen=[])
    assert (row.outcome.collisions, row.outcome.marginal_collisions, row.outcome.rate) == (1, 1, 1.0)


def test_medians_that_are_not_finite_do_not_exist() -> None:
    """Efforts of 1e40 overflow; the distance of walkers who leave each other does not."""
    found = labelled([0.9, 0.8, 0.7], [0.5] * 3)

    def violent(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        return torch.tensor([[-1e20, 0.0], [0.0, 0.0]]).expand(len(x), 2, 2)

    (row,) = played_table(Walkers(), violent, [found], seen=[])
    assert (row.outcome.collisions, row.outcome.median_excess_cost, row.outcome.median_excess_costs) == (0, None, None)
    assert row.outcome.median_label_cost is not None
    assert row.outcome.median_min_distance is not None
    nothing = torch.full((2, 2), torch.nan)
    (row,) = played_table(Walkers(), lambda tau, x, theta: nothing.expand(len(x), 2, 2), [found], seen=[])
    assert (row.outcome.median_min_distance, row.outcome.distance_quantiles) == (None, None)


def test_a_disturbance_reaches_the_episodes() -> None:
    """Walkers who step aside at once pass each other; who do so half a second late have collided by then."""
    found = labelled([0.0, 0.9], [0.5, 0.5])

    def aside(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """Aside for the first 0.2 s, after the first answer of all."""
        speed = torch.where((tau > 0.79) & (tau < 0.99), 3.0, 0.0)
        return torch.stack([torch.full_like(tau, 4.0), speed], -1).unsqueeze(1).expand(-1, 2, -1)

    def collisions(disturbance: Disturbance) -> int:
        (row,) = played_table(Walkers(), aside, [found], [], disturbance=disturbance)
        assert row.outcome.safe_starts == 2
        return row.outcome.collisions

    assert collisions(Disturbance()) == 0
    assert collisions(Disturbance(delay=25)) == 1

    def distance(disturbance: Disturbance) -> float | None:
        return played_table(Walkers(), aside, [found], [], disturbance=disturbance)[0].outcome.median_min_distance

    assert distance(Disturbance(0.0, 0, 5)) == distance(Disturbance())
    noisy = [distance(Disturbance(0.05, 0, seed)) for seed in (1, 1, 2)]
    assert noisy[0] == noisy[1]
    assert len({*noisy, distance(Disturbance())}) == 3


def test_quantiles_saturation_and_own_costs_are_of_safe_starts() -> None:
    heights = [0.5 + 0.01 * k for k in range(21)] + [0.05]
    found = labelled(heights, [0.5] * 21 + [-1.0])

    def fast(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """Both at full speed along x, the first one also across in the last tenth; who is not safe stands still."""
        u = torch.tensor([6.0, 0.0]).repeat(len(x), 2, 1)
        u[tau < 0.11, 0, 1] = 6.0
        return u * (x[:, 1:, 1:] > 0.1)

    (row,) = played_table(Walkers(), fast, [found], seen=[], dt=0.1)
    assert row.outcome.distance_quantiles == pytest.approx((1.02, 1.1, 1.2), abs=2e-3)
    assert row.outcome.distance_quantiles is not None
    assert row.outcome.distance_quantiles[-1] == row.outcome.median_min_distance
    assert row.outcome.saturated == pytest.approx((10 + 1 + 10) / 40)
    played = rollout(Walkers(), fast, found.x[:21, 0].float(), found.theta[:21].float(), 0.1)
    excess = -played.value.double() + found.value[:21, 0]
    assert row.outcome.median_excess_costs == pytest.approx(excess.median(0).values.tolist())
    assert row.outcome.median_excess_cost == pytest.approx(excess.sum(-1).median().item())


def test_steps_outside_the_pde_box_are_counted() -> None:
    """At 4 m/s for 1 s, from 0 and with one step in ten beyond the box."""
    game, found = Walkers(), labelled([0.9], [0.5])
    game.state_box.hi[..., 0] = 3.5
    (row,) = played_table(game, straight, [found], seen=[], dt=0.1)
    assert row.outcome.outside == pytest.approx(0.1)
    (row,) = played_table(Walkers(), straight, [found], seen=[], dt=0.1)
    assert row.outcome.outside == 0


def test_errors_are_weighted_over_the_nodes_of_converged_labels() -> None:
    """As torchmetrics' WeightedMeanAbsolutePercentageError: sum of errors over sum of labels."""
    found = labelled([0.9, 0.8, 0.7], [0.5, -0.2, 0.5], [GOOD, GOOD, BAD])
    asked: list[Points] = []

    def field(points: Points) -> Field:
        asked.append(points)
        value, costate = (column[:2].flatten(0, 1).float() for column in (found.value, found.costate))
        return Field(0.9 * value, points.theta, costate + 0.1)

    (row,) = played_table(Walkers(), straight, [found], seen=[], field=field)
    assert torch.equal(asked[0].x, found.x[:2].flatten(0, 1).float())
    torch.testing.assert_close(asked[0].tau, (1 - found.t).repeat(2).float())
    assert row.value_error == pytest.approx(0.1, rel=1e-5)
    assert row.costate_error == pytest.approx(0.1 / found.costate[:2].abs().mean().item(), rel=1e-5)


def test_errors_of_a_potential_are_those_of_players_values_and_own_costates() -> None:
    found = labelled([0.9, 0.7], [0.5, 0.5])

    def field(points: Points) -> PotentialField:
        value, own = found.value.flatten(0, 1).float(), own_costate(found.costate.flatten(0, 1)).float()
        nobody = points.theta[:, :1]
        return PotentialField(nobody, nobody, own.unsqueeze(1) + 0.1, 0.9 * value, nobody)

    (row,) = played_table(Walkers(), straight, [found], seen=[], field=field)
    assert row.value_error == pytest.approx(0.1, rel=1e-5)
    assert row.costate_error == pytest.approx(0.1 / own_costate(found.costate).abs().mean().item(), rel=1e-5)


def test_without_a_label_there_are_no_errors() -> None:
    def never(points: Points) -> Field:
        raise AssertionError("there is nothing to compare with")

    (row,) = played_table(Walkers(), straight, [labelled([0.9], [0.5], [BAD])], seen=[], field=never)
    assert (row.value_error, row.costate_error, row.outcome.saturated, row.outcome.distance_quantiles) == (None,) * 4


def test_types_outside_the_range_of_the_game_are_marked() -> None:
    sets = [labelled([0.9], [0.5], theta=theta) for theta in (0.0, 4.0, 4.5)]
    rows = played_table(Walkers(), straight, sets, seen=[])
    assert [row.extrapolated for row in rows] == [False, False, True]
    assert remarks(rows) == ["Outside the types that the game is made for, results extrapolate: (4.5, 4.5)."]


def test_types_outside_the_box_around_the_trained_ones_are_marked() -> None:
    sets = [labelled([0.9], [0.5], theta=theta) for theta in (0.5, 1.0, 1.5, 3.0, 4.0)]
    rows = played_table(Walkers(), straight, sets, seen=[(1.0, 3.0), (3.0, 1.0)])
    assert [row.outside_seen for row in rows] == [True, False, False, False, True]
    assert remarks(rows) == ["2 of 5 types lie outside the box around the trained ones: (0.5, 0.5), (4, 4)."]


@pytest.fixture
def nothing_safe() -> TypeRow:
    found = labelled([0.9, 0.9, 0.9], [-0.5, 0.01, 0.5], [GOOD, GOOD, BAD])
    return played_table(Walkers(), straight, [found], seen=[])[0]


def test_without_a_safe_start_there_is_no_rate(nothing_safe: TypeRow) -> None:
    assert nothing_safe.outcome.safe_starts == 0
    numbers = (
        "rate", "interval", "median_min_distance", "median_excess_cost", "median_label_cost", "distance_quantiles",
        "largest_excess_cost", "median_excess_costs", "saturated",
    )  # fmt: skip
    assert all(getattr(nothing_safe.outcome, name) is None for name in numbers)


def test_summary_says_not_applicable_and_not_zero(
    nothing_safe: TypeRow, capsys: pytest.CaptureFixture[str], tmp_path: object
) -> None:
    names = dict.fromkeys(("game", "operator", "activation"), "any")
    results = {**names, **RESULTS, "table": [nothing_safe.content()], "seconds": {}}
    show(results, tmp_path)
    printed = capsys.readouterr().out
    assert "n/a" in printed
    assert "0.00 %" not in printed
    assert "there is no collision rate (n/a)" in printed
    assert "No rate (n/a) at (1, 1): of 3 starts none has an equilibrium that keeps 0.02 m" in printed
    assert "1 unsolved, 1 inevitable, 1 marginal." in " ".join(printed.split())


def test_verdict_adds_types_and_names_the_worst(nothing_safe: TypeRow) -> None:
    sets = [labelled([0.9] * 3, [0.5] * 3), labelled([0.9, 0.05], [0.5] * 2, theta=2.0)]
    rows = [*played_table(Walkers(), straight, sets, seen=[]), nothing_safe]
    table = [row.content() for row in rows]
    assert verdict(table) == "1 collision in 5 safe starts (20.00 %); worst 50.00 % at (2, 2)."
    assert verdict(table[:1]) == "0 collisions in 3 safe starts (0.00 %)."


def test_remarks_name_the_unit_of_the_constraint(nothing_safe: TypeRow) -> None:
    for unit, expected in (("m", "keeps 0.5 m;"), ("", "keeps 0.5;")):
        said = CollisionTable().remarks([nothing_safe.content()], {"clearance": 0.5, "constraint_unit": unit})
        assert expected in said[1]


def test_rows_in_results_hold_the_outcome_beside_the_types(nothing_safe: TypeRow) -> None:
    content = nothing_safe.content()
    assert list(content) == [
        "theta", "seen", "extrapolated", "outside_seen", "value_error", "costate_error", *nothing_safe.outcome._fields,
    ]  # fmt: skip
    assert content["unsolved"] == nothing_safe.outcome.unsolved
