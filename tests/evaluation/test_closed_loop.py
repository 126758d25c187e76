from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch
from torch import Tensor

from hno.cli.summary import show, verdict
from hno.cli.tables import percent
from hno.evaluation.closed_loop import TypeRow, classify, collision_table
from hno.evaluation.rollout import Disturbance
from hno.types import Extremal, Status
from tests.fakes import fake_labels
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


def test_starts_are_safe_marginal_inevitable_or_unsolved() -> None:
    found = labelled([0] * 7, [0.5, 0.02, 0.019, 0.001, 0.0, -0.3, 0.5], [GOOD] * 6 + [BAD])
    safe, marginal = classify(found, clearance=0.02)
    assert safe.tolist() == [True, True, False, False, False, False, False]
    assert marginal.tolist() == [False, False, True, True, False, False, False]


def test_every_start_is_of_one_kind_and_marginal_ones_are_apart() -> None:
    clearances = [0.5, 0.5, 0.01, 0.01, -0.2, 0.5]
    heights = [0.05, 0.9, 0.05, 0.9, 0.05, 0.05]
    found = labelled(heights, clearances, [GOOD] * 5 + [BAD])
    (row,) = collision_table(Walkers(), straight, [found], seen=[])
    assert (row.starts, row.unsolved, row.inevitable, row.marginal, row.safe_starts) == (6, 1, 1, 2, 2)
    assert row.unsolved + row.inevitable + row.marginal + row.safe_starts == row.starts
    assert (row.collisions, row.marginal_collisions) == (1, 1)
    assert row.rate == 0.5
    assert row.interval == pytest.approx((0.012579, 0.987421), abs=1e-6)


def test_medians_are_over_safe_starts_and_compare_with_the_label() -> None:
    heights = [0.5, 0.6, 0.7, 0.05]
    found = labelled(heights, [0.5, 0.5, 0.5, -1.0])
    (row,) = collision_table(Walkers(), straight, [found], seen=[])
    assert row.median_min_distance == pytest.approx(1.2, abs=1e-3)
    label_cost = -found.value[:3, 0].sum(-1)
    assert row.median_label_cost == pytest.approx(label_cost.median().item())
    again = collision_table(Walkers(), straight, [found._replace(value=found.value - 50)], seen=[])
    assert row.median_excess_cost is not None
    assert again[0].median_excess_cost == pytest.approx(row.median_excess_cost - 100, rel=1e-6)


def test_rows_keep_their_type_and_order() -> None:
    sets = [labelled([0.9] * n, [0.5] * n, theta=theta) for n, theta in ((3, 1.0), (1, 4.0), (2, 0.5))]
    rows = collision_table(Walkers(), straight, sets, seen=[(4.0, 4.0)])
    assert [row.theta for row in rows] == [(1.0, 1.0), (4.0, 4.0), (0.5, 0.5)]
    assert [row.starts for row in rows] == [3, 1, 2]
    assert [row.seen for row in rows] == [False, True, False]


def test_collision_radius_is_that_of_the_rows_type() -> None:
    """Walkers miss each other by 0.6 m; the radius is 0.2 + 0.2 theta."""
    sets = [labelled([0.3], [0.5], theta=theta) for theta in (1.0, 4.0, 1.5)]
    rows = collision_table(Walkers(), straight, sets, seen=[])
    assert [row.collisions for row in rows] == [0, 1, 0]


def test_a_broken_policy_collides_everywhere() -> None:
    found = labelled([0.9, 0.9], [0.5, 0.01])
    nothing = torch.full((2, 2), torch.nan)
    (row,) = collision_table(Walkers(), lambda tau, x, theta: nothing.expand(len(x), 2, 2), [found], seen=[])
    assert (row.collisions, row.marginal_collisions, row.rate) == (1, 1, 1.0)


def test_a_disturbance_reaches_the_episodes() -> None:
    """Walkers who step aside at once pass each other; who do so half a second late have collided by then."""
    found = labelled([0.0, 0.9], [0.5, 0.5])

    def aside(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """Aside for the first 0.2 s, after the first answer of all."""
        speed = torch.where((tau > 0.79) & (tau < 0.99), 3.0, 0.0)
        return torch.stack([torch.full_like(tau, 4.0), speed], -1).unsqueeze(1).expand(-1, 2, -1)

    def collisions(disturbance: Disturbance) -> int:
        (row,) = collision_table(Walkers(), aside, [found], [], disturbance=disturbance)
        assert row.safe_starts == 2
        return row.collisions

    assert collisions(Disturbance()) == 0
    assert collisions(Disturbance(delay=25)) == 1

    def distance(disturbance: Disturbance) -> float | None:
        return collision_table(Walkers(), aside, [found], [], disturbance=disturbance)[0].median_min_distance

    assert distance(Disturbance(0.0, 0, 5)) == distance(Disturbance())
    noisy = [distance(Disturbance(0.05, 0, seed)) for seed in (1, 1, 2)]
    assert noisy[0] == noisy[1]
    assert len({*noisy, distance(Disturbance())}) == 3


@pytest.fixture
def nothing_safe() -> TypeRow:
    found = labelled([0.9, 0.9, 0.9], [-0.5, 0.01, 0.5], [GOOD, GOOD, BAD])
    return collision_table(Walkers(), straight, [found], seen=[])[0]


def test_without_a_safe_start_there_is_no_rate(nothing_safe: TypeRow) -> None:
    assert nothing_safe.safe_starts == 0
    numbers = ("rate", "interval", "median_min_distance", "median_excess_cost", "median_label_cost")
    assert all(getattr(nothing_safe, name) is None for name in numbers)


def test_summary_says_not_applicable_and_not_zero(
    nothing_safe: TypeRow, capsys: pytest.CaptureFixture[str], tmp_path: object
) -> None:
    names = dict.fromkeys(("game", "operator", "activation"), "any")
    results = {**names, "table": [nothing_safe._asdict()], "clearance": 0.02, "seconds": {}}
    show(results, tmp_path)
    printed = capsys.readouterr().out
    assert "n/a" in printed
    assert "0.00 %" not in printed
    assert "there is no collision rate (n/a)" in printed
    assert percent(None) == "n/a"


def test_verdict_adds_types_and_names_the_worst(nothing_safe: TypeRow) -> None:
    sets = [labelled([0.9] * 3, [0.5] * 3), labelled([0.9, 0.05], [0.5] * 2, theta=2.0)]
    rows = [*collision_table(Walkers(), straight, sets, seen=[]), nothing_safe]
    assert (
        verdict([row._asdict() for row in rows]) == "1 collisions in 5 safe starts (20.00 %); worst 50.00 % at (2, 2)."
    )
