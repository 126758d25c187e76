"""What ends a training that has diverged."""

from __future__ import annotations

import math
from collections.abc import Iterable
from types import SimpleNamespace

import pytest
import torch
from torch import nn

from hno.training.divergence import ERROR, DivergedError, StopOnDivergence

ADVICE = r"the training diverged\. Lower optimizer\.lr or set trainer\.gradient_clip_val\."


def step(callback: StopOnDivergence, number: int, loss: float, max_steps: int = 1000) -> None:
    trainer = SimpleNamespace(global_step=number, max_steps=max_steps)
    callback.on_train_batch_end(trainer, nn.Linear(1, 1), {"loss": torch.tensor(loss)}, None, number - 1)


@pytest.mark.parametrize("loss", [math.nan, math.inf, -math.inf])
def test_a_loss_that_is_not_finite_ends_the_training(loss: float) -> None:
    with pytest.raises(DivergedError, match=rf"The loss is {loss} at step 50: {ADVICE}"):
        step(StopOnDivergence(50), 50, loss)


def test_the_loss_is_looked_at_every_so_often_and_at_the_end() -> None:
    callback = StopOnDivergence(50)
    for number in (1, 49, 51, 99):
        step(callback, number, math.nan)
    for number in (50, 100):
        with pytest.raises(DivergedError):
            step(callback, number, math.nan)
    with pytest.raises(DivergedError, match="step 73"):
        step(callback, 73, math.nan, max_steps=73)


def test_a_large_loss_is_no_divergence() -> None:
    step(StopOnDivergence(1), 1, 1e30)


def validated(errors: Iterable[float], callback: StopOnDivergence | None = None) -> None:
    callback = callback or StopOnDivergence()
    for number, error in enumerate(errors):
        trainer = SimpleNamespace(global_step=100 * (number + 1), callback_metrics={ERROR: torch.tensor(error)})
        callback.on_validation_end(trainer, nn.Linear(1, 1))


@pytest.mark.parametrize("errors", [[3.0], [1.0, 9.9], [5.0, 0.5, 4.9, 0.4, 3.9], [0.1] * 20, [1e6, 1e6], [2.0, 0.0]])
def test_errors_may_grow_within_the_factor(errors: list[float]) -> None:
    validated(errors)


@pytest.mark.parametrize(
    ("errors", "message"),
    [
        ([1.0, 10.1], "The error of costates is 10.1 at step 200; it was 1: "),
        ([5.0, 0.5, 4.0, 5.1], "The error of costates is 5.1 at step 400; it was 0.5: "),
        ([0.5, math.inf], "The error of costates is inf at step 200; it was 0.5: "),
        ([0.5, math.nan], "The error of costates is nan at step 200; it was 0.5: "),
        ([math.nan], "The error of costates is nan at step 100: "),
        ([math.inf], "The error of costates is inf at step 100: "),
    ],
)
def test_an_error_beyond_the_factor_is_divergence(errors: list[float], message: str) -> None:
    validated(errors[:-1])
    with pytest.raises(DivergedError, match=message.replace(".", r"\.") + ADVICE):
        validated(errors)


def test_the_factor_can_be_chosen() -> None:
    validated([1.0, 2.9], StopOnDivergence(growth=3.0))
    with pytest.raises(DivergedError):
        validated([1.0, 3.1], StopOnDivergence(growth=3.0))


def test_the_smallest_error_survives_a_checkpoint() -> None:
    first, resumed = StopOnDivergence(), StopOnDivergence()
    validated([0.5, 2.0], first)
    resumed.load_state_dict(first.state_dict())
    with pytest.raises(DivergedError, match=r"5\.5 at step 100; it was 0\.5"):
        validated([5.5], resumed)
    fresh = StopOnDivergence()
    fresh.load_state_dict(StopOnDivergence().state_dict())
    validated([5.5], fresh)


def test_a_validation_without_that_error_is_not_judged() -> None:
    callback = StopOnDivergence()
    for _ in range(2):
        callback.on_validation_end(SimpleNamespace(global_step=1, callback_metrics={}), nn.Linear(1, 1))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_the_last_step_must_leave_finite_weights(value: float) -> None:
    net = nn.Sequential(nn.Linear(2, 2), nn.Linear(2, 2))
    StopOnDivergence().on_train_end(SimpleNamespace(), net)
    with torch.no_grad():
        net[1].weight[1, 0] = value
    with pytest.raises(DivergedError, match=f"weights that are not finite: {ADVICE}"):
        StopOnDivergence().on_train_end(SimpleNamespace(), net)
