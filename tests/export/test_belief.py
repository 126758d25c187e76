"""One player's belief with an exported controller, without torch."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from hno.control.belief import Believing, Learning
from hno.control.exported import load_exported
from hno.runtime import Believer, load

CASE = "narrow_road potential sin 1"
LEARNING = Learning(noise=0.005, memory=0.5, floor=5e-3)
KINDS = "c", "numpy"
Exported = Callable[[str, str], Path]


def candidates(player: int, own: float, count: int = 5) -> np.ndarray:
    """Both types of the narrow road, the own one fixed."""
    types = np.full((count, 2), own)
    types[:, 1 - player] = np.linspace(1, 5, count)
    return types


def motion(steps: int = 4) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Times to go, states and controls of both."""
    generator = np.random.default_rng(0)
    state = lambda: np.array([18, 4, 0, 20]) + generator.normal(0, 0.3, (2, 4)) * [3, 1, 0.1, 2]  # noqa: E731
    return [(2.5 - 0.1 * k, state(), generator.normal(0, 0.4, (2, 2))) for k in range(steps)]


@pytest.mark.parametrize("acts", ["mean", pytest.param("mode", marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", KINDS)
def test_it_is_the_policy_with_beliefs_for_one_player(exported: Exported, kind: str, acts: str) -> None:
    folder, theta = exported(CASE, kind), torch.tensor([[2.0, 4.5]])
    policy = Believing(load_exported(folder), 5, acts, LEARNING)
    policy.reset(torch.zeros(1, 2, 4), theta)
    players = [Believer(load(folder), i, candidates(i, float(theta[0, i])), acts, LEARNING) for i in (0, 1)]
    for tau, x, u in motion():
        together = policy.act(torch.tensor([tau]), torch.from_numpy(x).float().unsqueeze(0), theta)
        for i, player in enumerate(players):
            np.testing.assert_allclose(player.act(tau, x), together[0, i], atol=2e-3)
        policy.observe(torch.zeros(1, 2, 4), torch.from_numpy(u).float().unsqueeze(0), 0.1)
        for i, player in enumerate(players):
            player.observe(u, 0.1)
            np.testing.assert_allclose(player.belief, policy.belief[0, i], atol=2e-3)
    assert policy.belief.max() > 0.3, "something was learned"


@pytest.mark.parametrize("kind", KINDS)
def test_many_types_at_one_state_are_what_each_gets_alone(exported: Exported, kind: str) -> None:
    artefact, generator = load(exported(CASE, kind)), np.random.default_rng(1)
    types, (tau, x, _) = generator.uniform(1, 5, (7, 2)), motion(1)[0]
    many, transposed = artefact.many(types), artefact.many(np.asfortranarray(types))
    np.testing.assert_array_equal(transposed(tau, x), many(tau, x))
    for _ in range(2):
        batch = artefact.answers([tau] * 7, [x] * 7, types)["control"]
        np.testing.assert_allclose(many(tau, x), batch, atol=1e-4)
        types[3] = 1.5, 4.0
        many.replace(3, types[3])


@pytest.mark.parametrize("kind", KINDS)
def test_many_types_refuse_what_makes_no_sense(exported: Exported, kind: str) -> None:
    artefact, (tau, x, _) = load(exported(CASE, kind)), motion(1)[0]
    for types in (np.ones(2), np.ones((3, 3)), np.full((1, 2), np.nan)):
        with pytest.raises(ValueError, match=r"shape \(K, 2\)"):
            artefact.many(types)
    many = artefact.many(np.ones((3, 2)))
    for state, time in ((x[:1], tau), (x * np.nan, tau), (x, -1.0), (x, np.nan)):
        with pytest.raises(ValueError, match=r"Expected|finite|tau is|refused"):
            many(time, state)
    with pytest.raises(ValueError, match="finite"):
        many.replace(0, np.array([np.nan, 1]))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"acts": "expectation"}, "mean, mode"),
        ({"player": 2}, "from 0 to 1"),
        ({"types": np.array([[1.0, 2.0], [3.0, 4.0]])}, "own type"),
        ({"types": np.ones((0, 2))}, "own type"),
        ({"types": np.ones(3)}, "shape"),
        ({"learning": Learning(noise=-1)}, "noise"),
        ({"prior": [1.0, 2.0]}, "prior"),
    ],
)
def test_options_that_make_no_sense(exported: Exported, options: dict[str, object], message: str) -> None:
    given = {"player": 0, "types": candidates(0, 2.0), **options}
    with pytest.raises(ValueError, match=message):
        Believer(load(exported(CASE, "numpy")), **given)


@pytest.mark.parametrize("dt", [0.0, -0.1, np.nan, np.inf])
def test_times_that_make_no_sense_are_refused(exported: Exported, dt: float) -> None:
    player, (tau, x, u) = Believer(load(exported(CASE, "numpy")), 0, candidates(0, 2.0)), motion(1)[0]
    player.act(tau, x)
    before = player.belief.copy()
    with pytest.raises(ValueError, match="dt must be a positive time"):
        player.observe(u, dt)
    np.testing.assert_array_equal(player.belief, before)


def test_to_observe_before_acting_is_an_error(exported: Exported) -> None:
    with pytest.raises(RuntimeError, match="act"):
        Believer(load(exported(CASE, "numpy")), 0, candidates(0, 2.0)).observe(np.zeros((2, 2)), 0.1)
