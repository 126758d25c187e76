"""Paired comparisons against published intervals and the definition of the score test."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.stats import norm
from torch import Tensor

from hno.evaluation.comparison import DifferentGamesError, check_same_game, compare, mcnemar, tango
from hno.games import make

Z = float(norm.ppf(0.975))


@pytest.mark.parametrize(
    ("only_second", "only_first", "pairs", "interval"),
    [
        (1, 7, 21, (-0.5172, -0.0260)),  # Bentur et al. 2009
        (6, 16, 161, (-0.1240, -0.0054)),  # Cavo et al. 2012
    ],
)
def test_tango_intervals_are_the_published_ones(
    only_second: int, only_first: int, pairs: int, interval: tuple[float, float]
) -> None:
    """Fagerland, Lydersen, Laake: Statistical Analysis of Contingency Tables (2017), chapter 8."""
    assert tango(only_first, only_second, pairs) == pytest.approx(interval, abs=5e-5)


def test_the_exact_test_is_the_published_one() -> None:
    """Its mid-P variant counts half of the observed table: 0.0347 for 6 and 16 (same chapter)."""
    observed = math.comb(22, 6) * 0.5**22
    assert mcnemar(6, 16) - observed == pytest.approx(0.034690, abs=5e-7)
    assert mcnemar(6, 16) == mcnemar(16, 6)
    assert mcnemar(0, 5) == pytest.approx(2 * 0.5**5)
    assert mcnemar(0, 0) == mcnemar(4, 4) == 1.0


def score(first: int, second: int, pairs: int, delta: float) -> float:
    """The score statistic with the most likely nuisance parameter, found on a fine grid."""
    low, high = max(0.0, -delta), (1 - delta) / 2
    q = torch.linspace(low, high, 200_001, dtype=torch.float64)
    terms = ((first, q), (second, q + delta), (pairs - first - second, 1 - 2 * q - delta))
    zero = torch.zeros(1, dtype=torch.float64)
    likelihood = sum((count * p.clamp_min(0).log() if count else zero for count, p in terms), zero)
    best = float(q[int(likelihood.argmax())])
    return (second - first - pairs * delta) / math.sqrt(pairs * (2 * best + delta * (1 - delta)))


@pytest.mark.parametrize("counts", [(7, 1, 21), (0, 3, 40), (2, 2, 9), (10, 30, 100), (1, 0, 5000)])
def test_ends_are_where_the_score_test_begins_to_reject(counts: tuple[int, int, int]) -> None:
    low, high = tango(*counts)
    assert score(*counts, low) == pytest.approx(Z, abs=2e-3)
    assert score(*counts, high) == pytest.approx(-Z, abs=2e-3)


def test_intervals_hold_the_estimate_stay_in_range_and_mirror() -> None:
    for pairs in (1, 2, 5, 12):
        for first in range(pairs + 1):
            for second in range(pairs + 1 - first):
                low, high = tango(first, second, pairs)
                assert -1 <= low <= (second - first) / pairs <= high <= 1
                assert tango(second, first, pairs) == pytest.approx((-high, -low), abs=1e-9)


@pytest.mark.parametrize(("first", "second"), [(5, 15), (6, 15), (0, 3), (0, 4), (20, 8), (20, 9), (30, 18), (30, 17)])
def test_zero_is_inside_exactly_where_mcnemars_test_does_not_reject(first: int, second: int) -> None:
    low, high = tango(first, second, 200)
    assert (low <= 0 <= high) == ((first - second) ** 2 / (first + second) <= Z**2)


def test_without_discordant_pairs_the_interval_has_its_closed_form() -> None:
    low, high = tango(0, 0, 600)
    assert high == pytest.approx(Z**2 / (600 + Z**2), rel=1e-6)
    assert low == -high


def test_a_wider_confidence_is_a_wider_interval() -> None:
    narrow, wide = (tango(3, 9, 50, confidence) for confidence in (0.9, 0.99))
    assert wide[0] < narrow[0] < narrow[1] < wide[1]


def told(text: str) -> Tensor:
    return torch.tensor([letter == "x" for letter in text], dtype=torch.bool)


def test_pairs_are_counted_start_by_start() -> None:
    found = compare(told("xx.x...."), told("x.xx.x.."))
    assert (found.starts, found.both, found.only_reference, found.only_other) == (8, 2, 1, 2)
    assert found.difference == 1 / 8
    assert found.interval == tango(1, 2, 8)
    assert found.p_value == 1.0
    other = compare(told("x.xx.x.."), told("xx.x...."))
    assert other.difference == -1 / 8


def test_equal_counts_of_different_starts_are_not_agreement() -> None:
    same, crossed = compare(told("xx.."), told("xx..")), compare(told("xx.."), told("..xx"))
    assert same.difference == crossed.difference == 0
    assert (same.only_other, crossed.only_other) == (0, 2)


def test_without_starts_there_is_no_difference() -> None:
    found = compare(told(""), told(""))
    assert (found.starts, found.difference, found.interval, found.p_value) == (0, None, None, None)


def test_models_of_different_games_are_refused() -> None:
    road, wide = make("narrow_road"), make("narrow_road", radius=1.5)
    check_same_game(["a", "b"], [road, make("narrow_road")])
    with pytest.raises(DifferentGamesError, match=r"a plays NarrowRoad\(\), b plays Drone\(\)"):
        check_same_game(["a", "b"], [road, make("drone")])
    with pytest.raises(DifferentGamesError, match=r"c plays NarrowRoad\(radius=1.5\)\. Evaluate them one by one"):
        check_same_game(["a", "b", "c"], [road, road, wide])
