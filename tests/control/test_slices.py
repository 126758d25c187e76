"""Slices: what a policy says on a grid over two coordinates."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from hno.control import Feedback
from hno.games import make
from hno.operators import Architecture, Choice, make_operator
from tests.operators.conftest import small_operator


@pytest.fixture(scope="module")
def policy() -> Feedback:
    return Feedback(small_operator("narrow_road").requires_grad_(False))


def test_a_slice_is_what_the_policy_says_at_its_states(policy: Feedback) -> None:
    found = policy.slice("gap", ("v_1", 19, 22), theta=(1.0, 4.0), tau=2.0, at={"offset": 0.5}, points=5)
    tau, theta = np.full((5, 5), 2.0), np.broadcast_to([1.0, 4.0], (5, 5, 2))
    np.testing.assert_allclose(found.value, policy.value(tau, found.x, theta))
    np.testing.assert_allclose(found.costate, policy.costate(tau, found.x, theta))
    np.testing.assert_allclose(found.control, policy.act(tau, found.x, theta))
    assert (found.tau, found.theta, found.potential) == (2.0, (1.0, 4.0), None)


def test_its_states_have_the_coordinates_of_its_sides(policy: Feedback) -> None:
    found = policy.slice("gap", ("v_1", 19, 22), at={"offset": 0.5, "psi_2": 0.1}, points=5)
    x = torch.from_numpy(found.x)
    wanted = {"gap": found.across.values[None, :], "v_1": found.up.values[:, None], "offset": 0.5, "psi_2": 0.1}
    for name, values in wanted.items():
        of = policy.game.coordinate(name).of(x).numpy()
        np.testing.assert_allclose(of, np.broadcast_to(values, (5, 5)), atol=1e-9)
    assert (found.across.label, found.up.label) == ("gap, m", "v_1, m/s")
    assert (found.up.values[0], found.up.values[-1]) == (19, 22)


def test_by_default_half_the_game_is_left_and_types_are_in_the_middle(policy: Feedback) -> None:
    found = policy.slice(points=2)
    assert (found.tau, found.theta) == (policy.game.horizon / 2, (3.0, 3.0))


def test_one_violated_constraint_of_one_player_is_a_violation(policy: Feedback) -> None:
    safe = -np.ones((2, 2, 3, 2))
    safe[0, 1, 2, 1] = 0.5
    violation = policy.slice(points=2)._replace(constraint=safe).violation
    np.testing.assert_array_equal(violation, [[-1, 0.5], [-1, -1]])


def test_the_violation_is_positive_exactly_in_the_violation_set(policy: Feedback) -> None:
    found = policy.slice(points=21)
    x, theta = torch.from_numpy(found.x).float(), torch.tensor(found.theta)
    violated = policy.game.violates(x, theta.expand(21, 21, -1)).numpy()
    np.testing.assert_array_equal(found.violation >= 0, violated)
    assert 0 < violated.mean() < 1


def test_a_potential_has_a_slice_of_w() -> None:
    small = Choice("deeponet", {"width": 8, "depth": 1})
    policy = Feedback(make_operator(make("drone"), Architecture(Choice("potential"), small)).requires_grad_(False))
    found = policy.slice(points=3)
    at = np.full((3, 3), found.tau), found.x, np.broadcast_to(found.theta, (3, 3, 2))
    assert found.potential is not None
    np.testing.assert_allclose(found.potential, policy.potential(*at))
    assert found.costate.shape == (3, 3, 1, 2, 6)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"across": "gab", "up": "offset"}, "no coordinate 'gab'. Did you mean 'gap'"),
        ({"across": "gap", "up": "px_2"}, "cannot have both 'gap' and 'px_2': to change one changes the other"),
        ({"across": "gap", "up": "gap"}, "cannot have both 'gap' and 'gap'"),
        ({"at": {"py_1": 4.0}}, "cannot have both 'offset' and 'py_1'"),
        ({"across": "gap"}, "two coordinates: give `across` and `up`"),
        ({"across": ("gap", 3, 3), "up": "offset"}, "'gap' must run from a number to a larger one; got 3 to 3"),
        ({"across": ("gap", 3), "up": "offset"}, r"An axis is the name of a coordinate, or \(name, from, to\)"),
        ({"points": 1}, "at least 2; got 1"),
        ({"tau": 9.0}, "from 0 to the horizon of 3 s"),
        ({"theta": (1.0, 2.0, 3.0)}, "Expected tau"),
    ],
)
def test_what_makes_no_slice_is_one_error(policy: Feedback, asked: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        policy.slice(**asked)
