from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
from torch import Tensor
from torchmetrics import Metric

from hno.evaluation.metrics import BinnedMean, CollisionRate, Quantiles, SaturatedShare, clopper_pearson
from hno.games import Box, make


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


GENERATOR = torch.Generator().manual_seed(0)
SHARES = (0.05, 0.25, 0.5)
UNIT = Box([-1.0, 0.0], [1.0, 4.0])
CONTROLS = torch.lerp(UNIT.lo, UNIT.hi, torch.randint(9, (40, 7, 2, 2), generator=GENERATOR) / 8)
COUNTED = torch.rand(40, generator=GENERATOR) < 0.7
NUMBERS = torch.randn(40, generator=GENERATOR)
MEASURED = torch.randn(40, 2, generator=GENERATOR)
PLACE = torch.randint(4, (40,), generator=GENERATOR)

METRICS: dict[str, tuple[Callable[[], Metric], tuple[Tensor, ...]]] = {
    "collisions": (CollisionRate, (NUMBERS, COUNTED)),
    "quantiles": (lambda: Quantiles(SHARES), (NUMBERS,)),
    "saturated": (lambda: SaturatedShare(UNIT), (CONTROLS, COUNTED)),
    "binned mean": (lambda: BinnedMean(4), (MEASURED, PLACE)),
}


def computed(build: Callable[[], Metric], updates: Sequence[Sequence[Tensor]]) -> Tensor:
    metric = build()
    for arguments in updates:
        metric.update(*arguments)
    return metric.compute()


@pytest.mark.parametrize("name", METRICS)
@pytest.mark.parametrize("size", [1, 7, 39])
def test_updates_may_be_split(name: str, size: int) -> None:
    build, arguments = METRICS[name]
    parts = list(zip(*(column.split(size) for column in arguments), strict=True))
    torch.testing.assert_close(computed(build, parts), computed(build, [arguments]), rtol=1e-12, atol=0)


@pytest.mark.parametrize("name", METRICS)
def test_processes_add_up(name: str) -> None:
    """`merge_state` reduces as processes do, by the reduction that every state has."""
    build, arguments = METRICS[name]
    first, second = build(), build()
    assert all(first._reductions.values())
    first.update(*(column[:15] for column in arguments))
    second.update(*(column[15:] for column in arguments))
    first.merge_state(second)
    torch.testing.assert_close(first.compute(), computed(build, [arguments]), rtol=1e-12, atol=0)


@pytest.mark.parametrize("name", METRICS)
def test_a_reset_forgets(name: str) -> None:
    build, arguments = METRICS[name]
    metric = build()
    metric.update(*arguments)
    metric.reset()
    metric.update(*(column[:9] for column in arguments))
    assert torch.equal(metric.compute(), computed(build, [[column[:9] for column in arguments]]))


def test_quantiles_are_those_of_numpy() -> None:
    expected = np.quantile(NUMBERS.double().numpy(), SHARES, method="lower")
    assert computed(lambda: Quantiles(SHARES), [(NUMBERS,)]).tolist() == expected.tolist()
    assert float(computed(lambda: Quantiles([0.5]), [(NUMBERS,)])) == float(NUMBERS.median())
    assert computed(lambda: Quantiles([0.0, 1.0]), [(NUMBERS,)]).tolist() == [NUMBERS.min(), NUMBERS.max()]


def test_quantiles_of_nothing_are_no_numbers() -> None:
    assert bool(computed(lambda: Quantiles(SHARES), [(NUMBERS[:0],)]).isnan().all())


def test_saturated_controls_are_those_on_a_bound() -> None:
    chosen = CONTROLS[COUNTED]
    on_bound = (chosen == UNIT.lo) | (chosen == UNIT.hi)
    assert 0 < float(on_bound.float().mean()) < 1
    share = computed(lambda: SaturatedShare(UNIT), [(CONTROLS, COUNTED)])
    assert float(share) == pytest.approx(float(on_bound.double().mean()), rel=1e-6)


def test_a_drones_bounds_count_though_they_go_through_a_tangent() -> None:
    game = make("drone")
    u = game.optimal_control(torch.zeros(5, 2, 6), torch.full((5, 2, 2, 6), 1e6)).unsqueeze(1)
    assert float(computed(lambda: SaturatedShare(game.control_box), [(u, torch.ones(5, dtype=torch.bool))])) == 1


def test_a_share_of_no_controls_is_no_number() -> None:
    share = computed(lambda: SaturatedShare(UNIT), [(CONTROLS, torch.zeros(40, dtype=torch.bool))])
    assert math.isnan(float(share))


def test_binned_means_are_means_of_bins() -> None:
    found = computed(lambda: BinnedMean(5), [(MEASURED, PLACE)])
    expected = [MEASURED[place == PLACE].abs().double().mean() for place in range(4)]
    torch.testing.assert_close(found[:4], torch.stack(expected))
    assert math.isnan(float(found[4]))


def test_saturation_is_of_each_players_own_box() -> None:
    box = Box([[-1.0], [-5.0]], [[1.0], [5.0]])
    u = torch.tensor([[[[1.0], [1.0]], [[0.0], [-5.0]]]])
    assert float(computed(lambda: SaturatedShare(box), [(u, torch.ones(1, dtype=torch.bool))])) == 0.5
