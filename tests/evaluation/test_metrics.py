from __future__ import annotations

import math

import pytest
import torch

from hno.evaluation.metrics import CollisionRate, clopper_pearson


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        (0, 100, 0.0, 1 - 0.025 ** (1 / 100)),
        (100, 100, 0.025 ** (1 / 100), 1.0),
        (0, 1, 0.0, 0.975),
        (4, 20, 0.057334, 0.436614),
        (10, 100, 0.049005, 0.176223),
        (1, 2872, 0.0000088, 0.0019384),
    ],
)
def test_clopper_pearson_against_known_intervals(successes: int, trials: int, low: float, high: float) -> None:
    assert clopper_pearson(successes, trials) == pytest.approx((low, high), abs=1e-6)


def test_no_interval_without_trials() -> None:
    assert clopper_pearson(0, 0) is None


def test_interval_keeps_its_promise() -> None:
    """Beyond each end the observed count would be in a tail of 2.5 %."""
    interval = clopper_pearson(3, 50)
    assert interval is not None
    low, high = interval
    tail = sum(math.comb(50, k) * high**k * (1 - high) ** (50 - k) for k in range(4))
    assert tail == pytest.approx(0.025, rel=1e-6)
    tail = sum(math.comb(50, k) * low**k * (1 - low) ** (50 - k) for k in range(3, 51))
    assert tail == pytest.approx(0.025, rel=1e-6)


def test_collisions_are_counted_over_updates_among_the_counted() -> None:
    metric = CollisionRate()
    metric.update(torch.tensor([0.5, -0.1, -0.2]), torch.tensor([True, True, False]))
    metric.update(torch.tensor([0.0, 1.0]), torch.tensor([True, True]))
    assert (int(metric.collisions), int(metric.episodes)) == (2, 4)
    assert metric.compute().item() == 0.5
    metric.reset()
    assert int(metric.episodes) == 0


def test_what_is_not_a_number_is_a_collision() -> None:
    metric = CollisionRate()
    metric.update(torch.tensor([torch.nan, 1.0]), torch.tensor([True, True]))
    assert metric.compute().item() == 0.5


def test_rate_without_episodes_is_no_number() -> None:
    metric = CollisionRate()
    metric.update(torch.tensor([-1.0]), torch.tensor([False]))
    assert math.isnan(metric.compute().item())
