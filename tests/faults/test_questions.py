"""Controllers, simulation and solver asked as people ask, and asked nonsense."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from hno.control import Feedback
from hno.control.questions import outside
from hno.control.rollout import rollout
from hno.games.base import ExtrapolationWarning
from hno.pontryagin.solve import solve
from hno.types import Points
from tests.crossing import Crossing
from tests.faults.test_derivatives import potential
from tests.operators.conftest import random_points, small_operator
from tests.walkers import Walkers

ASKED = ("act", "value", "costate")
SHAPES = r"Expected tau \(B,\), x \(B, 2, 4\) and theta \(B, 2\)"


@pytest.fixture(params=["value", "ensemble", "three players", "potential"])
def policy(request: pytest.FixtureRequest) -> Feedback:
    made: dict[str, Callable[[], Any]] = {
        "value": small_operator,
        "ensemble": lambda: small_operator(members=3),
        "three players": lambda: small_operator(Crossing()),
        "potential": lambda: potential(exact=True),
    }
    return Feedback(made[request.param]().requires_grad_(False))


@pytest.fixture
def points(policy: Feedback) -> Points:
    return random_points(policy.game, 6)


def plain() -> Feedback:
    return Feedback(small_operator().requires_grad_(False))


def close(found: Any, wanted: Any) -> None:
    np.testing.assert_allclose(np.asarray(found), np.asarray(wanted), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", ASKED)
def test_one_state_is_answered_without_a_batch(policy: Feedback, points: Points, name: str) -> None:
    ask, whole = getattr(policy, name), getattr(policy, name)(*points)
    for row, (tau, x, theta) in enumerate(zip(*points, strict=True)):
        for time in (tau, float(tau), tau.numpy()):
            found = ask(time, x, theta)
            assert found.shape == whole[row].shape
            close(found, whole[row])


@pytest.mark.parametrize("name", ASKED)
@pytest.mark.parametrize("batch", [(0,), (2, 0), (3, 2), (1, 1, 6)])
def test_states_of_any_leading_shape_are_answered(
    policy: Feedback, points: Points, name: str, batch: tuple[int, ...]
) -> None:
    count, ask = math.prod(batch), getattr(policy, name)
    whole = ask(*points)[:count]
    found = ask(*(part[:count].reshape(*batch, *part.shape[1:]) for part in points))
    assert found.shape == (*batch, *whole.shape[1:])
    close(found.reshape(whole.shape), whole)


@pytest.mark.parametrize("name", ASKED)
def test_one_time_and_one_type_are_those_of_all_states(policy: Feedback, points: Points, name: str) -> None:
    ask, (tau, x, theta) = getattr(policy, name), points
    wanted = ask(tau[:1].expand(6), x, theta[:1].expand(6, -1))
    close(ask(float(tau[0]), x, theta[0].tolist()), wanted)


@pytest.mark.parametrize("name", ASKED)
@pytest.mark.parametrize("kind", [np.float64, np.float32, np.float16, ">f8"])
def test_arrays_in_arrays_out(policy: Feedback, points: Points, name: str, kind: Any) -> None:
    ask, given = getattr(policy, name), [part.numpy().astype(kind) for part in points]
    for array in given:
        array.flags.writeable = False
    found, same = ask(*given), ask(*(np.ascontiguousarray(part[::-1])[::-1] for part in given))
    assert isinstance(found, np.ndarray)
    assert found.dtype == np.dtype(kind)
    wanted = ask(*(torch.tensor(np.array(part, dtype=np.float32)) for part in given))
    np.testing.assert_allclose(np.asarray(found, np.float64), wanted, rtol=2e-3, atol=1e-3)
    np.testing.assert_array_equal(found, same)


@pytest.mark.parametrize("kind", [np.int64, np.int8, np.uint16, torch.int32, list])
def test_whole_numbers_are_numbers(kind: Any) -> None:
    game, x = Walkers(), [[[1, 0], [2, 1]], [[0, 1], [3, 0]]]
    policy = Feedback(small_operator(game).requires_grad_(False))
    wanted = policy(torch.ones(2), torch.tensor(x).float(), torch.tensor([[1.0, 2.0]] * 2))
    if kind is list:
        found = policy(1, x, [1, 2])  # type: ignore[type-var]
    elif isinstance(kind, torch.dtype):
        found = policy(1, torch.tensor(x, dtype=kind), torch.tensor([1, 2]))
    else:
        found = policy(1, np.array(x, dtype=kind), np.array([1, 2]))
    assert isinstance(found, np.ndarray) == (kind is not list and not isinstance(kind, torch.dtype))
    assert np.asarray(found).dtype == np.float32
    close(found, wanted)


def test_the_branch_is_a_whole_number_for_every_kind_of_question() -> None:
    policy = Feedback(potential(exact=True).requires_grad_(False))
    tau, x, theta = random_points(policy.game, 4)
    found = policy.branch(tau, x, theta)
    assert found.dtype == torch.int64
    assert policy.branch(tau, x.numpy(), theta).tolist() == found.tolist()
    assert policy.branch(tau[0], x[0], theta[0]).shape == policy.potential(tau[0], x[0], theta[0]).shape == ()
    assert Feedback(policy.operator, checked=False).branch(tau, x, theta).dtype == torch.int64


@pytest.mark.parametrize("name", ASKED)
@pytest.mark.parametrize("tau", [-0.1, 3.1, -1e30, 1e4])
def test_a_time_to_go_outside_the_horizon_is_an_error_that_names_it(name: str, tau: float) -> None:
    policy = plain()
    times, x, theta = random_points(policy.game, 3)
    for asked in (times.where(torch.arange(3) != 1, tau), tau):
        with pytest.raises(ValueError, match="from 0 to the horizon of 3 s"):
            getattr(policy, name)(asked, x, theta)


@pytest.mark.parametrize("tau", [0.0, -0.0, 3.0, 3.0 + 1e-6, -1e-6, np.nextafter(np.float32(3), np.float32(4))])
def test_a_time_to_go_at_either_end_is_answered_up_to_rounding(tau: float) -> None:
    policy = plain()
    _, x, theta = random_points(policy.game, 3)
    assert bool(policy(tau, x, theta).isfinite().all())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda tau, x, theta: (tau, x[:, :1], theta), SHAPES),
        (lambda tau, x, theta: (tau, x[..., :3], theta), SHAPES),
        (lambda tau, x, theta: (tau[:2], x, theta), SHAPES),
        (lambda tau, x, theta: (tau[:, None], x, theta), SHAPES),
        (lambda tau, x, theta: (tau, x, theta[:2]), SHAPES),
        (lambda tau, x, theta: (tau, x, theta[:, :1]), SHAPES),
        (lambda tau, x, theta: (tau, x, 1.0), SHAPES),
        (lambda tau, x, theta: (tau, x[0, 0], theta), SHAPES),
        (lambda tau, x, theta: (tau, 1.0, theta), SHAPES),
        (lambda tau, x, theta: (tau * torch.nan, x, theta), "finite"),
        (lambda tau, x, theta: (tau, x / 0, theta), "finite"),
        (lambda tau, x, theta: (tau, x.numpy() * np.nan, theta), "finite"),
        (lambda tau, x, theta: (tau, x, theta * torch.inf), "theta must be finite"),
        (lambda tau, x, theta: ("soon", x, theta), "tau must be a tensor or an array of real numbers"),
        (lambda tau, x, theta: (None, x, theta), "tau must be a tensor or an array of real numbers"),
        (lambda tau, x, theta: (tau, [[1, 2], [3]], theta), "x must be a tensor or an array of real numbers"),
        (lambda tau, x, theta: (tau, x.numpy() > 0, theta), "x must be a tensor or an array of real numbers"),
        (lambda tau, x, theta: (tau, x > 0, theta), "x must be real numbers; got torch.bool"),
        (lambda tau, x, theta: (tau, x + 0j, theta), "x must be real numbers; got torch.complex64"),
        (lambda tau, x, theta: (tau, x.numpy() + 0j, theta), "x must be a tensor or an array of real numbers"),
        (lambda tau, x, theta: (tau, x, {"a": 1}), "theta must be a tensor or an array of real numbers"),
    ],
)  # fmt: skip
def test_what_is_no_question_is_refused_by_name(change: Callable[..., Any], message: str) -> None:
    policy = plain()
    for name in ASKED:
        with pytest.raises(ValueError, match=message):
            getattr(policy, name)(*change(*random_points(policy.game, 3)))


def test_states_outside_the_pde_box_are_one_warning_of_a_policy() -> None:
    policy = plain()
    tau, x, theta = random_points(policy.game, 3)
    far = x.clone()
    far[1, 0, 0] += 1e4
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        policy(tau, x, theta)
        policy(tau, policy.game.state_box.hi.expand(3, -1, -1).double().numpy() * (1 + 1e-7), theta)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        for name, _ in itertools.product(ASKED, range(3)):
            getattr(policy, name)(tau, far, theta)
    assert [one.category for one in seen] == [ExtrapolationWarning]
    with pytest.warns(ExtrapolationWarning, match="outside the PDE box"):
        Feedback(policy.operator).value(tau, far, theta)


def test_a_state_that_wraps_around_is_never_outside() -> None:
    game = Walkers()
    x = torch.tensor([[[0.0, 99.0], [0.0, 0.0]], [[-99.0, 0.0], [0.0, 0.0]]])
    assert outside(game, x).tolist() == [True, True]
    game.periodic = (1,)
    assert outside(game, x).tolist() == [False, True]


ENTRIES = st.one_of(st.none(), st.text(max_size=3), st.booleans(), st.integers(), st.floats(width=32), st.binary())
QUESTIONS = st.one_of(
    ENTRIES,
    st.recursive(st.floats(-50, 50) | ENTRIES, lambda inner: st.lists(inner, max_size=4), max_leaves=12),
    st.lists(st.lists(st.floats(allow_nan=True), min_size=4, max_size=4), min_size=2, max_size=2),
)
SOUND = {
    "tau": st.floats(0, 3),
    "x": st.lists(st.lists(st.floats(-90, 90), min_size=4, max_size=4), min_size=2, max_size=2),
    "theta": st.lists(st.floats(1, 5), min_size=2, max_size=2),
}


def mostly_sound(name: str) -> st.SearchStrategy[Any]:
    return st.integers(0, 3).flatmap(lambda draw: SOUND[name] if draw else QUESTIONS)


def asked_at_random(cases: int) -> int:
    """How many of so many random questions were answered; the others were refused in our own words."""
    policy, answered, said = plain(), 0, set[str]()

    @settings(max_examples=cases, deadline=None, derandomize=True, database=None)
    @given(tau=mostly_sound("tau"), x=mostly_sound("x"), theta=mostly_sound("theta"))
    def ask(tau: Any, x: Any, theta: Any) -> None:
        nonlocal answered
        try:
            found = policy.value(tau, x, theta)
        except ValueError as error:
            said.add(str(error))
            return
        answered += 1
        assert found.shape[-1] == 2

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExtrapolationWarning)
        ask()
    assert all(any(words in one for words in ("Expected tau", "must be", "tau is the time to go")) for one in said)
    return answered


def test_random_questions_are_answered_or_refused() -> None:
    assert 0 < asked_at_random(100) < 100


@pytest.mark.slow
def test_ten_thousand_random_questions_are_answered_or_refused() -> None:
    print(f"10000 cases: random questions, of which {asked_at_random(10_000)} have an answer")


def still(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
    return torch.zeros_like(x)


def test_a_rollout_takes_arrays_lists_and_no_start_at_all() -> None:
    game = Walkers()
    x0 = game.initial_box.sample(3, torch.Generator().manual_seed(0))
    wanted = rollout(game, still, x0, torch.ones(3, 2), 0.2)
    for states, types in ((x0.numpy(), np.ones((3, 2))), (x0.tolist(), [1, 1]), (x0, [1.0, 1.0])):
        close(rollout(game, still, states, types, 0.2).x, wanted.x)
    assert rollout(game, still, x0[:0], torch.ones(0, 2), 0.2).collided.shape == (0,)
    policy = Feedback(small_operator(game).requires_grad_(False))
    assert rollout(game, policy, np.zeros((0, 2, 2)), [1, 1], 0.2).u.shape == (0, 5, 2, 2)


@pytest.mark.parametrize(
    ("x0", "theta", "message"),
    [
        (torch.zeros(2, 2), torch.ones(2), r"\(B, 2, 2\)"),
        (torch.zeros(3, 2, 4), torch.ones(3, 2), r"\(B, 2, 2\)"),
        (torch.zeros(3, 2, 2), torch.ones(2, 2), r"\(\d, 2\)|\(B, 2\)"),
        (torch.full((3, 2, 2), torch.nan), torch.ones(3, 2), "x0 has entries that are not finite"),
        (torch.zeros(3, 2, 2), torch.full((3, 2), torch.inf), "theta has entries that are not finite"),
        ("here", torch.ones(3, 2), "x0 must be a tensor or an array of real numbers"),
    ],
)
def test_starts_that_are_none_are_refused_by_name(x0: Any, theta: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rollout(Walkers(), still, x0, theta, 0.2)
    with pytest.raises(ValueError, match=message):
        solve(Walkers(), x0, theta)


def test_no_start_is_nothing_to_solve() -> None:
    with pytest.raises(ValueError, match="B > 0"):
        solve(Walkers(), np.zeros((0, 2, 2)), np.zeros((0, 2)))


def test_arrays_are_solved_like_tensors() -> None:
    game = Walkers()
    x0 = game.initial_box.sample(1, torch.Generator().manual_seed(0)).double()
    found = solve(game, x0.numpy(), [[1, 1]])
    assert torch.equal(found.x, solve(game, x0, torch.ones(1, 2)).x)
