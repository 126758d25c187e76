from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from hno.evaluation.metrics import clopper_pearson, credible, quantiles, saturated_share
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


GENERATOR = torch.Generator().manual_seed(0)
SHARES = (0.05, 0.25, 0.5)
UNIT = Box([-1.0, 0.0], [1.0, 4.0])
CONTROLS = torch.lerp(UNIT.lo, UNIT.hi, torch.randint(9, (40, 7, 2, 2), generator=GENERATOR) / 8)
NUMBERS = torch.randn(40, generator=GENERATOR)
MEASURED = torch.randn(40, 2, generator=GENERATOR)


def test_the_credible_set_is_the_smallest_one() -> None:
    """Against all subsets, of random beliefs; of equals the first ones are in it."""
    generator = torch.Generator().manual_seed(0)
    beliefs = torch.rand(40, 5, generator=generator, dtype=torch.float64).pow(3)
    beliefs /= beliefs.sum(-1, keepdim=True)
    subsets = torch.cartesian_prod(*[torch.tensor([False, True])] * 5)
    chosen = credible(beliefs, 0.9)
    for belief, found in zip(beliefs, chosen, strict=True):
        enough = subsets[(subsets * belief).sum(-1) >= 0.9]
        assert (belief * found).sum() >= 0.9
        assert found.sum() == enough.sum(-1).min()
    assert credible(torch.full((4,), 0.25), 0.5).tolist() == [True, True, False, False]
    assert credible(torch.tensor([0.0, 1.0, 0.0])).tolist() == [False, True, False]


def test_quantiles_are_those_of_numpy() -> None:
    expected = np.quantile(NUMBERS.double().numpy(), SHARES, method="lower")
    assert quantiles(NUMBERS, SHARES).tolist() == expected.tolist()
    assert float(quantiles(NUMBERS, [0.5])) == float(NUMBERS.median())
    assert quantiles(NUMBERS, [0.0, 1.0]).tolist() == [NUMBERS.min(), NUMBERS.max()]
    assert quantiles(MEASURED, [0.5])[0].tolist() == MEASURED.median(0).values.tolist()


def test_quantiles_of_nothing_are_no_numbers() -> None:
    assert bool(quantiles(NUMBERS[:0], SHARES).isnan().all())
    assert bool(quantiles(torch.tensor([1.0, torch.nan]), SHARES).isnan().all())
    assert quantiles(MEASURED[:0], SHARES).shape == (3, 2)


def test_saturated_controls_are_those_on_a_bound() -> None:
    on_bound = (UNIT.lo == CONTROLS) | (UNIT.hi == CONTROLS)
    assert 0 < float(on_bound.float().mean()) < 1
    torch.testing.assert_close(saturated_share(CONTROLS, UNIT), on_bound.double().flatten(1).mean(1))


def test_a_drones_bounds_count_though_they_go_through_a_tangent() -> None:
    game = make("drone")
    u = game.optimal_control(torch.zeros(5, 2, 6), torch.full((5, 2, 2, 6), 1e6)).unsqueeze(1)
    assert saturated_share(u, game.control_box).tolist() == [1] * 5


def test_saturation_is_of_each_players_own_box() -> None:
    box = Box([[-1.0], [-5.0]], [[1.0], [5.0]])
    u = torch.tensor([[[[1.0], [1.0]], [[0.0], [-5.0]]]])
    assert saturated_share(u, box).tolist() == [0.5]
