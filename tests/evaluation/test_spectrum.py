from __future__ import annotations

import json
from typing import Any

import pytest
import torch
from torch import Tensor

from hno.evaluation.spectrum import Ratio, condition_ratio, condition_ratios, spectrum, summary


def matrix(*eigenvalues: float) -> Tensor:
    """A symmetric matrix with these eigenvalues and random eigenvectors."""
    generator = torch.Generator().manual_seed(0)
    size = len(eigenvalues)
    basis = torch.linalg.qr(torch.randn(size, size, generator=generator, dtype=torch.float64))[0]
    return basis * torch.tensor(eigenvalues, dtype=torch.float64) @ basis.mT


def test_eigenvalues_come_back_from_the_largest() -> None:
    found = spectrum(matrix(0.5, 8.0, 2.0))
    torch.testing.assert_close(found.eigenvalues, torch.tensor([8.0, 2.0, 0.5], dtype=torch.float64))
    assert (found.rank, found.condition) == (3, pytest.approx(16.0))


def test_what_is_below_the_cutoff_does_not_count() -> None:
    values = matrix(1.0, 1e-3, 1e-6, 0.0)
    assert (spectrum(values).rank, spectrum(values).condition) == (3, pytest.approx(1e6))
    assert (spectrum(values, 1e-4).rank, spectrum(values, 1e-4).condition) == (2, pytest.approx(1e3))
    assert spectrum(values).cutoff == 4 * 2.0**-52


@pytest.mark.parametrize("scale", [1e-30, 3.0, 1e30])
def test_scale_changes_nothing_but_the_eigenvalues(scale: float) -> None:
    one, other = spectrum(matrix(4.0, 1.0, 1e-3, 0.0)), spectrum(scale * matrix(4.0, 1.0, 1e-3, 0.0))
    assert other.condition == pytest.approx(one.condition)
    assert other.effective_rank == pytest.approx(one.effective_rank)
    assert other.rank == one.rank == 3


def test_effective_rank_counts_equal_eigenvalues() -> None:
    assert spectrum(torch.eye(7, dtype=torch.float64)).effective_rank == pytest.approx(7)
    assert spectrum(matrix(5.0, 0.0, 0.0)).effective_rank == pytest.approx(1)
    assert spectrum(matrix(2.0, 2.0, 2.0, 0.0, 0.0)).effective_rank == pytest.approx(3)
    assert spectrum(matrix(2.0, 1.0, 1.0)).effective_rank == pytest.approx(2**1.5), "exp(1/2 ln 2 + 2/4 ln 4)"


def test_a_matrix_of_zeros_has_no_condition_number() -> None:
    found = spectrum(torch.zeros(3, 3, dtype=torch.float64))
    assert (found.rank, found.condition, found.effective_rank) == (0, None, None)
    assert summary(found)["curve"] == []


def test_a_matrix_that_is_not_finite_is_refused() -> None:
    with pytest.raises(ValueError, match="not finite"):
        spectrum(matrix(1.0, 2.0) / 0)


def test_summary_keeps_the_ends_of_the_curve() -> None:
    found = spectrum(torch.diag(torch.arange(500, 0, -1, dtype=torch.float64)))
    plain = json.loads(json.dumps(summary(found)))
    numbers, values = zip(*plain["curve"], strict=True)
    assert (plain["rows"], plain["rank"], plain["condition"]) == (500, 500, 500.0)
    assert (numbers[:3], numbers[-1]) == ((1, 2, 3), 500)
    assert values == tuple(501.0 - number for number in numbers)
    assert len(numbers) <= 40


def entry(theta: tuple[float, float], *eigenvalues: float, points: int = 2) -> dict[str, Any]:
    """An entry of a section "ntk", whose product has the squares of the kernel's eigenvalues."""
    squares = (value**2 for value in eigenvalues)
    spectra = {"kernel": summary(spectrum(matrix(*eigenvalues))), "product": summary(spectrum(matrix(*squares)))}
    return {"theta": list(theta), "points": points, **spectra}


def test_ratios_of_the_paper() -> None:
    corner, other = (1.0, 5.0), (5.0, 5.0)
    results = {
        "sin": [entry(other, 1.0, 1.0), entry(corner, 8.0, 2.0)],
        "tanh": [entry(corner, 6.0, 3.0), entry(other, 9.0, 3.0)],
        "relu": [entry(corner, 40.0, 1.0), entry(other, 1.0, 0.5), entry((3.0, 3.0), 1.0, 1.0)],
    }
    found = condition_ratios(results)
    assert [row["theta"] for row in found] == [[1.0, 5.0], [5.0, 5.0]]
    values = [(row[kind][name].value) for row in found for kind in ("kernel", "product") for name in ("sin", "relu")]
    assert values == pytest.approx([2 / 4, 2 / 40, 4 / 16, 4 / 1600, 3, 3 / 2, 9, 9 / 4])
    assert {row[kind][name].bound for row in found for kind in ("kernel", "product") for name in ("sin", "relu")} == {
        "="
    }


def test_a_ratio_with_a_matrix_that_is_cut_off_is_a_bound() -> None:
    whole, cut = entry((1.0, 1.0), 4.0, 2.0)["kernel"], entry((1.0, 1.0), 4.0, 0.0)["kernel"]
    nothing, limit = summary(spectrum(matrix(0.0, 0.0))), 1 / (2 * 2.0**-52)
    assert condition_ratio(cut, whole) == Ratio(pytest.approx(limit / 2), ">")
    assert condition_ratio(whole, cut) == Ratio(pytest.approx(2 / limit), "<")
    for pair in ((cut, cut), (nothing, whole), (whole, nothing)):
        assert condition_ratio(*pair) == Ratio(None, "n/a")


def test_ratios_that_cannot_be_formed() -> None:
    section = [entry((1.0, 1.0), 2.0, 1.0)]
    with pytest.raises(ValueError, match="'tanh' and at least one other; got sin, relu"):
        condition_ratios({"sin": section, "relu": section})
    with pytest.raises(ValueError, match="at least one other"):
        condition_ratios({"tanh": section})
    with pytest.raises(ValueError, match="no player type in common"):
        condition_ratios({"tanh": section, "sin": [entry((1.0, 5.0), 2.0, 1.0)]})
    with pytest.raises(ValueError, match="no player type in common"):
        condition_ratios({"tanh": section, "sin": [{"theta": [1.0, 1.0], "points": 0, "kernel": None}]})
    with pytest.raises(ValueError, match="numbers of points"):
        condition_ratios({"tanh": section, "sin": [entry((1.0, 1.0), 2.0, 1.0, points=3)]})


def test_a_network_without_a_product_has_a_ratio_of_kernels_alone() -> None:
    section, other = [entry((1.0, 1.0), 2.0, 1.0)], [entry((1.0, 1.0), 8.0, 1.0) | {"product": None}]
    (row,) = condition_ratios({"tanh": section, "sin": other})
    assert row["kernel"]["sin"] == Ratio(pytest.approx(1 / 4), "=")
    assert row["product"]["sin"] == Ratio(None, "n/a")
