"""A game whose dynamics or costs are not finite somewhere."""

from __future__ import annotations

import sys
from typing import Any

import pytest
import torch
from torch import Tensor

from hno.control.rollout import rollout
from hno.pontryagin import Solver, solve
from hno.pontryagin.newton import Newton
from hno.types import Status
from tests.walkers import Walkers

QUICK = Solver(newton=Newton(steps=12, full_steps=4), extra_nodes=12)
"""Gives up soon."""


def holed(**methods: Any) -> Walkers:
    """Walkers with a hole in the middle of their way: what is there is NaN."""
    game = Walkers()
    for name, method in methods.items():
        object.__setattr__(game, name, method)
    return game


def in_hole(x: Tensor) -> Tensor:
    return (x[..., 0] > 1.5) & (x[..., 0] < 2.5)


def drift(x: Tensor) -> Tensor:
    return torch.zeros_like(x).masked_fill(in_hole(x).unsqueeze(-1), torch.nan)


def terminal_value(x: Tensor) -> Tensor:
    return Walkers().to(x).terminal_value(x).masked_fill(x[..., 1] > 0.1, torch.nan)


def forward(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
    return torch.tensor([4.0, 0.0]).to(x).expand_as(x)


def starts() -> Tensor:
    """The first two walk around nothing and through the hole; the last one begins behind it."""
    return torch.tensor([[[0.0, 0.9], [0.0, 0.9]], [[0.4, 0.9], [0.3, 0.9]], [[2.6, 0.9], [2.6, 0.9]]])


def test_an_episode_that_meets_the_hole_is_a_collision_and_said(caplog: pytest.LogCaptureFixture) -> None:
    played = rollout(holed(drift=drift), forward, starts(), [1, 1], 0.1)
    assert played.lost.tolist() == played.collided.tolist() == [True, True, False]
    assert "2 of 3 episodes do not stay finite: they count as collisions." in caplog.text
    caplog.clear()
    assert not rollout(Walkers(), forward, starts()[2:], [1, 1], 0.1).collided.any()
    assert not caplog.text


def test_an_episode_whose_cost_is_nan_is_a_collision() -> None:
    played = rollout(holed(terminal_value=terminal_value), forward, starts(), [1, 1], 0.1)
    assert bool((played.clearance > 0).all())
    assert played.lost.tolist() == played.collided.tolist() == [True, True, True]


@pytest.mark.parametrize("methods", [{"drift": drift}, {"terminal_value": terminal_value}])
def test_no_label_is_made_of_nan(methods: dict[str, Any]) -> None:
    """Whatever converges is finite; what cannot be solved says so."""
    found = solve(holed(**methods), starts(), torch.ones(3, 2), QUICK)
    converged = found.status == Status.CONVERGED
    assert not bool(converged[:2].any())
    for name in ("x", "costate", "u", "value", "clearance", "reintegration"):
        assert bool(getattr(found, name)[converged].isfinite().all()), name


def test_a_certificate_that_is_nan_is_no_label(monkeypatch: pytest.MonkeyPatch) -> None:
    unknown = lambda game, at: torch.full((len(at.t),), torch.nan, dtype=torch.float64)  # noqa: E731
    monkeypatch.setattr(sys.modules["hno.pontryagin.solve"], "reintegration_error", unknown)
    assert solve(Walkers(), starts()[:1], torch.ones(1, 2)).status.tolist() == [Status.NOT_FINITE]
