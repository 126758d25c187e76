"""Exported controllers say what the operator says in double precision."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from hno.export.trace import in_double
from hno.export.write import TOLERANCE, check
from hno.runtime import load
from tests.export.conftest import operator_of

CASES = ("narrow_road potential sin 1", "bicycle value tanh 1")
MORE = (
    "intersection value tanh 3",
    "lane_change value tanh 3",
    "lane_change potential relu 1",
    "drone potential tanh 1",
    "drone value sin 1",
    "intersection value relu 1",
    "intersection potential sin 1",
    "three_walkers potential sin 1",
    "bicycle potential sin 1",
    "three_walkers value tanh 3",
    "car_and_cyclist value sin 1",
    "car_and_cyclist potential sin 1",
)


def cases() -> Iterator[object]:
    """The first in every language, the second in one; the others take minutes."""
    for case in (*CASES, *MORE):
        for kind in ("numpy", "c", "onnx", "torch"):
            fast = case == CASES[0] or (case == CASES[1] and kind == "numpy")
            yield pytest.param(case, kind, marks=() if fast else pytest.mark.slow)


@pytest.mark.parametrize(("case", "kind"), list(cases()))
def test_ten_thousand_answers_differ_by_rounding(exported, case: str, kind: str) -> None:
    checked = check(load(exported(case, kind)), in_double(operator_of(case)), 10_000, seed=2)
    assert checked.error <= TOLERANCE, checked
    assert checked.left_out < 0.05
    wanted = {"value", "dvalue_dtau", "costate", "control"}
    assert wanted <= set(checked.errors)


def test_an_answer_depends_on_its_own_row_alone(exported) -> None:
    artefact = load(exported(CASES[0], "numpy"))
    generator = torch.Generator().manual_seed(3)
    game = operator_of(CASES[0]).game
    tau, x, theta = torch.rand(1500) * game.horizon, game.state_box.sample(1500, generator), torch.ones(1500, 2)
    theta[::2] = 3.5
    whole = artefact.answers(tau.numpy(), x.numpy(), theta.numpy())
    part = artefact.answers(tau[1400:1410].numpy(), x[1400:1410].numpy(), theta[1400:1410].numpy())
    for name, values in part.items():
        np.testing.assert_allclose(values, whole[name][1400:1410], rtol=2e-5, atol=1e-4)
    none = artefact.answers(tau[:0], x[:0], theta[:0])
    assert {name: len(values) for name, values in none.items()} == dict.fromkeys(whole, 0)
