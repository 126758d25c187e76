"""What ends a training that has diverged."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from torch import nn

from hno.training.divergence import BAD_BATCH, ERROR, DivergedError, StopOnDivergence
from hno.training.saving import CheckpointFiles
from hno.types import Points, Sample

ADVICE = r"the training diverged\. Lower optimizer\.lr or set trainer\.gradient_clip_val\."


@pytest.fixture
def stop(tmp_path: Path) -> StopOnDivergence:
    """The callback of a run that has saved nothing yet."""
    return StopOnDivergence(tmp_path, CheckpointFiles())


def trainer(step: int = 49, **entries: Any) -> Any:
    """As much of a trainer as is asked for, after some steps."""
    return SimpleNamespace(global_step=step, global_rank=0, precision_plugin=None, **entries)


def step(callback: StopOnDivergence, net: nn.Module, loss: float = 1.0, grad: float = 1.0, number: int = 50) -> None:
    """A training step up to where the optimiser would change the weights."""
    optimizer, at = torch.optim.SGD(net.parameters()), trainer(number - 1)
    for weights in net.parameters():
        weights.grad = torch.ones_like(weights)
    net.weight.grad[0, 0] = grad
    callback.on_train_batch_start(at, net, {"bvp": Sample(Points(torch.tensor([number]), *EMPTY))}, number)
    callback.on_before_backward(at, net, torch.tensor(loss))
    callback.on_before_optimizer_step(at, net, optimizer)


EMPTY = torch.zeros(1, 2, 4), torch.zeros(1, 2)
NOT_FINITE = [math.nan, math.inf, -math.inf]


def culprit(folder: Path) -> int:
    """The step whose batch was kept."""
    return int(load_file(folder / BAD_BATCH)["bvp.points.tau"])


@pytest.mark.parametrize("number", [1, 37, 50])
@pytest.mark.parametrize("loss", NOT_FINITE)
def test_a_loss_that_is_not_finite_ends_the_training(
    stop: StopOnDivergence, tmp_path: Path, loss: float, number: int
) -> None:
    with pytest.raises(
        DivergedError, match=rf"The loss is {loss} at step {number}: {ADVICE} The batch of that step is"
    ):
        step(stop, nn.Linear(2, 2), loss, number=number)
    assert culprit(tmp_path) == number


@pytest.mark.parametrize("grad", NOT_FINITE)
def test_a_gradient_that_is_not_finite_ends_the_training(stop: StopOnDivergence, tmp_path: Path, grad: float) -> None:
    with pytest.raises(DivergedError, match=f"A gradient is not finite at step 50: {ADVICE}"):
        step(stop, nn.Linear(2, 2), grad=grad)
    assert culprit(tmp_path) == 50


def test_a_scaler_skips_bad_gradients_itself(stop: StopOnDivergence) -> None:
    at, net = trainer(), nn.Linear(2, 2)
    at.precision_plugin = SimpleNamespace(scaler=object())
    net.weight.grad = torch.full_like(net.weight, math.inf)
    stop.on_before_backward(at, net, torch.tensor(1.0))
    stop.on_before_optimizer_step(at, net, torch.optim.SGD(net.parameters()))


def test_large_numbers_are_no_divergence(stop: StopOnDivergence) -> None:
    step(stop, nn.Linear(2, 2), loss=1e38, grad=3e38)


def test_weights_that_a_step_spoiled_are_blamed_on_its_batch(stop: StopOnDivergence, tmp_path: Path) -> None:
    net = nn.Linear(2, 2)
    step(stop, net, number=7)
    with torch.no_grad():
        net.weight[0, 0] = math.inf
    with pytest.raises(DivergedError, match=f"Step 7 left weights that are not finite: {ADVICE}"):
        step(stop, net, math.nan, number=8)
    assert culprit(tmp_path) == 7


@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize("where", ["operator.weight", "the state of the optimizer"])
def test_nothing_that_is_not_finite_is_saved(stop: StopOnDivergence, tmp_path: Path, where: str, value: float) -> None:
    """The boxes of a game may be."""
    net, stop.files.latest = nn.Linear(2, 2), tmp_path / "last.ckpt"
    step(stop, net)
    weights, state = torch.ones(3), torch.ones(3)
    content: dict[str, Any] = {
        "state_dict": {"operator.weight": weights, "operator.game.state_box.hi": torch.tensor(math.inf)},
        "optimizer_states": [{"state": {0: {"exp_avg": [state]}}}],
    }
    stop.on_save_checkpoint(trainer(50), net, content)
    (weights if where == "operator.weight" else state)[1] = value
    latest = f"The last good checkpoint is {tmp_path / 'last.ckpt'}"
    with pytest.raises(DivergedError, match=f"Step 50 left {where} with entries that are not finite: .*{latest}"):
        stop.on_save_checkpoint(trainer(50), net, content)
    assert culprit(tmp_path) == 50


def fresh(**options: float) -> StopOnDivergence:
    """A callback that has nothing to write."""
    return StopOnDivergence(Path("unused"), CheckpointFiles(), **options)


def validated(errors: Iterable[float], callback: StopOnDivergence | None = None) -> None:
    callback = callback or fresh()
    for number, error in enumerate(errors):
        metrics = {ERROR: torch.tensor(error)}
        callback.on_validation_end(trainer(100 * (number + 1), callback_metrics=metrics), nn.Linear(1, 1))


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
    validated([1.0, 2.9], fresh(growth=3.0))
    with pytest.raises(DivergedError):
        validated([1.0, 3.1], fresh(growth=3.0))


def test_the_smallest_error_survives_a_checkpoint() -> None:
    first, resumed = fresh(), fresh()
    validated([0.5, 2.0], first)
    resumed.load_state_dict(first.state_dict())
    with pytest.raises(DivergedError, match=r"5\.5 at step 100; it was 0\.5"):
        validated([5.5], resumed)
    new = fresh()
    new.load_state_dict(fresh().state_dict())
    validated([5.5], new)


def test_a_validation_without_that_error_is_not_judged() -> None:
    callback = fresh()
    for _ in range(2):
        callback.on_validation_end(trainer(1, callback_metrics={}), nn.Linear(1, 1))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_the_last_step_must_leave_finite_weights(value: float) -> None:
    net = nn.Sequential(nn.Linear(2, 2), nn.Linear(2, 2))
    fresh().on_train_end(trainer(9), net)
    with torch.no_grad():
        net[1].weight[1, 0] = value
    with pytest.raises(DivergedError, match=f"Step 9 left weights that are not finite: {ADVICE}"):
        fresh().on_train_end(trainer(9), net)
