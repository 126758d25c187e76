"""Starts that two recipes both played: the paired test, and its correction for several of them."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from hno.evaluation.starts import Starts, holm, key_of, paired, starts_from

ONES = (1.0, 1.0)
TWOS = (2.0, 2.0)


def run(collided: str, counted: str | None = None, theta: tuple[float, ...] = ONES, key: str = "key"):
    return {theta: Starts(theta, key, counted or "1" * len(collided), collided)}


def test_one_run_each_is_mcnemars_exact_test():
    found = paired([run("0000011100")], [run("1111100100")])
    assert found[:3] == (10, 5, 2)
    assert found.p_value == pytest.approx(binomtest(5, 7).pvalue)


def test_the_other_order_mirrors_the_comparison():
    one, other = [run("0101000"), run("0111000")], [run("1110001")]
    here, there = paired(one, other), paired(other, one)
    assert (here.better, here.worse, here.p_value) == (there.worse, there.better, there.p_value)
    assert here[1:3] == (3, 1)  # the fourth start is worse; at the third half as many runs collide


def test_shares_of_runs_are_compared_and_not_their_numbers():
    found = paired([run("10"), run("10")], [run("10")])
    assert (found.better, found.worse, found.p_value) == (0, 0, 1.0)


def test_starts_without_a_safe_equilibrium_do_not_count():
    found = paired([run("000", "101")], [run("011", "101")])
    assert found[:3] == (2, 1, 0)


@pytest.mark.parametrize(
    "other",
    [
        pytest.param([], id="no run"),
        pytest.param([{}], id="nothing kept"),
        pytest.param([run("00", key="others")], id="other starts"),
        pytest.param([run("00", "10")], id="others count"),
        pytest.param([run("00", theta=TWOS)], id="other types"),
        pytest.param([run("00"), run("00") | run("00", theta=TWOS)], id="more types in one run"),
    ],
)
def test_runs_that_did_not_play_the_same_are_not_compared(other):
    assert paired([run("00")], other) is None


@given(st.lists(st.floats(0, 1), max_size=8))
def test_holm_keeps_the_order_and_lowers_nothing(p_values):
    found = holm(p_values)
    order = np.argsort(p_values, kind="stable")
    assert all(low <= high <= 1 for low, high in zip(p_values, found, strict=True))
    assert (np.diff(np.array(found)[order]) >= 0).all()


def test_holm_of_an_example_by_hand():
    # 0.01 * 4; 0.02 * 3; then 0.03 * 2 and 0.04 * 1, where the second would fall below the one before it
    assert holm([0.04, 0.01, 0.03, 0.02]) == pytest.approx([0.06, 0.04, 0.06, 0.06])
    assert holm([0.9, 0.6]) == [1.0, 1.0]


def test_a_key_names_start_states():
    x = torch.tensor([[[15.0, 18.0], [15.5, 17.0]]])
    assert key_of(x) == key_of(x.double()) == key_of(x.clone())
    assert len({key_of(x), key_of(x + 1e-3), key_of(x.flip(1))}) == 3


@pytest.mark.parametrize(
    "content",
    [
        None, {}, {"theta": 1, "key": "k", "counted": "1", "collided": "0"},
        {"theta": [1], "key": "k", "counted": "11", "collided": "0"},
        {"theta": [1], "key": "k", "counted": "12", "collided": "00"},
    ],
)  # fmt: skip
def test_an_entry_that_is_no_record_is_refused(content):
    with pytest.raises(ValueError, match=r"expected theta|digits 0 and 1"):
        starts_from(content)
