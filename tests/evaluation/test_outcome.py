"""What came of episodes, on episodes that are known."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from hno.control.rollout import rollout
from hno.evaluation.metrics import clopper_pearson
from hno.evaluation.outcome import Outcome, numbers_of, outcome, outcomes, pooled
from hno.games import Game
from hno.types import Extremal, Trajectory, join, part
from tests.fakes import fake_labels
from tests.lq import LinearQuadratic
from tests.walkers import Walkers

GAME = Walkers()


def straight(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
    """Walk along x at 4 m/s and into whoever comes."""
    return torch.tensor([4.0, 0.0]).expand(len(x), 2, 2)


def played(heights: list[float]) -> Trajectory:
    """Walkers of one height miss each other by twice that."""
    x0, theta = torch.zeros(len(heights), 2, 2), torch.zeros(len(heights), 2)
    x0[:, :, 1] = torch.tensor(heights).unsqueeze(-1)
    return rollout(GAME, straight, x0, theta, 0.1)


def came(labels: Extremal, episodes: Trajectory, game: Game = GAME) -> Outcome:
    """What came of episodes from the starts of labels."""
    return outcome(numbers_of(game, labels, episodes), 0.02)


def costing(cost: Tensor) -> Extremal:
    """Labels with these costs of the players, (B, 2)."""
    label = fake_labels(GAME, count=len(cost))
    label.value[:, 0] = -cost
    return label


def test_costs_are_compared_with_those_of_the_labels_row_by_row() -> None:
    episodes = played([0.5, 0.6, 0.7])
    cheaper = torch.tensor([1.0, 5.0, 2.0])
    found = came(costing(-episodes.value.double() - cheaper[:, None] / 2), episodes)
    assert (found.safe_starts, found.collisions) == (3, 0)
    assert found.median_excess_cost == pytest.approx(2)
    assert found.largest_excess_cost == pytest.approx(5)
    assert found.median_excess_costs == pytest.approx((1, 1))


def test_a_start_that_does_not_count_changes_no_number_of_those_that_do() -> None:
    episodes = played([0.0, 0.5, 0.6])
    labels = costing(torch.ones(3, 2))
    labels.clearance[0] = -1.0
    rest = torch.tensor([1, 2])
    alone = came(part(labels, rest), Trajectory(episodes.t, *(c[rest] for c in episodes[1:])))
    assert came(labels, episodes) == alone._replace(starts=3, inevitable=1)


def test_a_broken_policy_is_no_safe_one() -> None:
    episodes = played([0.9, 0.9])
    broken = episodes._replace(clearance=torch.full((2,), torch.nan), u=episodes.u * torch.nan)
    found = came(costing(torch.zeros(2, 2)), broken)
    assert (found.collisions, found.rate) == (2, 1.0)


def test_types_together_are_one_set_of_episodes() -> None:
    halves = [played([0.0, 0.5]), played([0.6])]
    labels = [costing(torch.ones(2, 2)), costing(torch.ones(1, 2))]
    parts, whole = outcomes([numbers_of(GAME, *pair) for pair in zip(labels, halves, strict=True)], 0.02)
    assert whole == came(join(labels), played([0.0, 0.5, 0.6]))
    assert parts == [came(*pair) for pair in zip(labels, halves, strict=True)]
    assert (whole.collisions, whole.safe_starts) == (1, 3)
    assert whole.largest_excess_cost == max(found.largest_excess_cost or 0 for found in parts)


def test_one_player_has_costs_but_no_distance() -> None:
    a, b, r, q, s = (torch.full((1, 1, 1), c) for c in (0.4, 1.3, 0.7, 0.1, 0.9))
    game = LinearQuadratic(a, b, r[..., 0], q, s)
    labels = fake_labels(game, (0.5,), 3)
    u = torch.zeros(3, 10, 1, 1)
    episodes = Trajectory(
        labels.t.float(), labels.x.float(), u, -torch.ones(3, 1), torch.ones(3), torch.full((3,), torch.inf)
    )
    found = came(labels, episodes, game)
    assert (found.safe_starts, found.collisions, found.saturated) == (3, 0, 0.0)
    assert (found.median_min_distance, found.distance_quantiles) == (None, None)
    assert found.median_excess_costs == pytest.approx((found.median_excess_cost,))


def row(theta: tuple[float, ...], collisions: int, safe: int, above: float | None = 1.0, cost: float | None = 10.0):
    counts = {"theta": theta, "collisions": collisions, "safe_starts": safe}
    return counts | {"median_excess_cost": above, "median_label_cost": cost}


def test_counts_add_and_the_worst_type_is_that_of_the_highest_rate_not_count() -> None:
    whole = pooled([row((1, 1), 3, 300), row((1, 5), 2, 20), row((5, 5), 0, 80)])
    assert (whole.collisions, whole.safe_starts, whole.rate) == (5, 400, 5 / 400)
    assert whole.interval == clopper_pearson(5, 400)
    assert (whole.worst_theta, whole.worst_rate) == ((1, 5), 0.1)


def test_where_nothing_collides_no_type_is_the_worst() -> None:
    whole = pooled([row((1, 1), 0, 300), row((1, 5), 0, 20)])
    assert (whole.worst_theta, whole.worst_rate, whole.rate) == (None, 0, 0)


def test_excess_is_relative_to_the_equilibrium_and_negative_costs_keep_its_sign() -> None:
    table = [row((1, 1), 0, 9, 1.0, 10.0), row((1, 2), 0, 9, 3.0, -10.0), row((1, 3), 0, 9, -2.0, 10.0)]
    assert pooled(table).relative_excess == pytest.approx(0.1)
    assert pooled(table[1:2]).relative_excess == pytest.approx(0.3)


def test_types_without_safe_starts_count_for_nothing() -> None:
    table = [row((1, 1), 1, 10), row((5, 5), 0, 0)]
    assert pooled(table) == pooled(table[:1])


@pytest.mark.parametrize("missing", [row((1, 2), 0, 9, above=None), row((1, 2), 0, 9, cost=None)])
def test_costs_that_were_not_finite_leave_those_of_other_types(missing: dict[str, object]) -> None:
    assert pooled([row((1, 1), 0, 9), missing]).relative_excess == pytest.approx(0.1)


@pytest.mark.parametrize("table", [[], [row((5, 5), 0, 0)]])
def test_what_does_not_exist_is_none(table: list[dict[str, object]]) -> None:
    assert pooled(table) == (0, 0, None, None, None, None, None)
