"""Numbers that stop being finite while an operator trains."""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import lightning as L
import pytest
import torch
from safetensors.torch import load_file

from hno.training.divergence import BAD_BATCH, DivergedError
from hno.training.saving import LAST, PREVIOUS, read_content
from tests.faults.checkpoints import EVERY, run

STEPS = 4 * EVERY


class Poison(L.Callback):
    """At one step, something is not finite."""

    def __init__(self, what: str, step: int, value: float) -> None:
        self.what, self.step, self.value = what, step, value
        self.weights = list[torch.Tensor]()

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: Any, *others: object) -> None:
        self.weights = [weights.detach().clone() for weights in pl_module.parameters()]
        if trainer.global_step == self.step and self.what == "weight":
            next(pl_module.operator.networks.parameters()).data.fill_(self.value)
        if trainer.global_step == self.step and self.what == "optimizer":
            trainer.optimizers[0].state[next(pl_module.parameters())]["exp_avg"].fill_(self.value)

    def on_after_backward(self, trainer: L.Trainer, pl_module: Any) -> None:
        if trainer.global_step == self.step and self.what == "gradient":
            next(p.grad for p in pl_module.parameters() if p.grad is not None).fill_(self.value)


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("step", [2 * EVERY - 1, 2 * EVERY, 2 * EVERY + 1])
@pytest.mark.parametrize("what", ["weight", "optimizer", "gradient"])
def test_what_is_not_finite_ends_the_training_and_is_never_saved(
    tmp_path: Path, what: str, step: int, value: float
) -> None:
    """Around a validation, which saves."""
    poison = Poison(what, step, value)
    with pytest.raises(DivergedError, match=r"The batch of that step is in .* The last good checkpoint is ") as error:
        run(tmp_path, steps=STEPS, callbacks=[poison])
    *_, good = str(error.value).removesuffix(".").split()
    contents = {path: read_content(path) for path in tmp_path.glob("*.ckpt")}
    assert Path(good) in contents
    assert contents[Path(good)]["global_step"] in (EVERY, 2 * EVERY - 1, 2 * EVERY)
    for content in contents.values():
        assert all(bool(weights.isfinite().all()) for weights in content["state_dict"].values())
        assert content["global_step"] <= 2 * EVERY
    batch = load_file(tmp_path / BAD_BATCH)
    assert {"bvp.points.x", "bvp.labels.value", "interior.points.tau"} <= batch.keys()
    if what == "gradient":
        assert all(bool(weights.isfinite().all()) for weights in poison.weights), "it did not reach the weights"
        assert f"A gradient is not finite at step {step + 1}:" in str(error.value)


@pytest.mark.parametrize("name", ["adam", "soap"])
@pytest.mark.parametrize("rate", [1e3, 1e30])
def test_an_absurd_rate_leaves_finite_checkpoints(tmp_path: Path, name: str, rate: float) -> None:
    with suppress(DivergedError):
        run(tmp_path, steps=STEPS, optimizer={"name": name, "lr": rate})
    for path in tmp_path.glob("*.ckpt"):
        assert all(bool(weights.isfinite().all()) for weights in read_content(path)["state_dict"].values())


def test_a_training_keeps_its_last_two_checkpoints(tmp_path: Path) -> None:
    run(tmp_path, steps=3 * EVERY - 1)
    steps = [read_content(tmp_path / name)["global_step"] for name in (LAST, PREVIOUS)]
    assert steps == [3 * EVERY - 1, 3 * EVERY - 2]


def test_a_step_with_a_validation_after_it_can_be_repeated(tmp_path: Path) -> None:
    run(tmp_path, steps=2 * EVERY)
    steps = [read_content(tmp_path / name)["global_step"] for name in (LAST, PREVIOUS)]
    assert steps == [2 * EVERY, 2 * EVERY - 1]
