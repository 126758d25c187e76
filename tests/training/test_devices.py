"""Several devices, here processes of one processor, train as one does."""

from __future__ import annotations

import os
import shutil
import signal
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning as L
import pytest
import safetensors.torch
import torch
from torch import Tensor

from hno.data import GameData
from hno.losses import LossTerm, Objective, View, make_objective
from hno.losses.supervised import ValueDeviation
from hno.operators import ValueOperator
from hno.processes import Interrupted, interruptible
from hno.training import Fitted, fit, together
from hno.training.adaptive import Adaptive, AdaptiveLabels, Candidates
from hno.training.callbacks import callbacks
from hno.training.divergence import BAD_BATCH, DivergedError
from hno.training.saving import BEST, LAST, read_content
from hno.training.together import RankError
from hno.training.trainer import check_devices
from hno.training.validation import ClosedLoopValidation
from hno.types import Extremal, Sample, Trajectory
from tests.fakes import fake_solve
from tests.operators.conftest import small_operator
from tests.training.test_fit import WEIGHTS, PowerCut, PowerCutError, equal, labelled_data, potential_operator, settings

STEPS, EVERY = 50, 10


def doubled(sample: Sample) -> Sample:
    """The same in float64."""
    points, labels, types = sample
    assert types is not None
    return Sample(
        type(points)(*(column.double() for column in points)),
        None if labels is None else type(labels)(*(c.double() if c.is_floating_point() else c for c in labels)),
        types._replace(distinct=types.distinct.double()),
    )


class DoubleData(GameData):
    """The batches of a training, in float64."""

    def batch(self, step: int, sizes: Mapping[str, int | None] | None = None) -> dict[str, Sample]:
        return {name: doubled(sample) for name, sample in super().batch(step, sizes).items()}

    def visit(self, played: Trajectory, step: int = -1) -> None:
        super().visit(played._replace(t=played.t.float(), x=played.x.float()), step)


class Watch(L.Callback):
    """Losses of all steps."""

    def __init__(self) -> None:
        self.losses: list[float] = []

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: Any, outputs: Any, *others: object) -> None:
        self.losses.append(float(outputs["loss"]))


def trained(folder: Path, devices: int, *, double: bool = True, **changes: Any) -> tuple[Watch, ValueOperator, Fitted]:
    """A training with everything in it that has to be the same in all processes."""
    potential = changes.pop("potential", False)
    operator, watch = potential_operator() if potential else small_operator(), Watch()
    weights = WEIGHTS | ({"branches": 1.0} if potential else {})
    objective = make_objective({name: {} for name in weights}, weights, balance=True, hardest=0.5)
    data = labelled_data(sampler={"box": 0.3, "labels": 0.3, "rollout": 0.4}, potential=potential)
    data.setup("fit")
    data.batch_sizes["terminal"] = 7
    if double:
        operator, objective = operator.double(), objective.double()
        assert data.val_rows is not None
        data.val_rows, data.__class__ = doubled(data.val_rows), DoubleData
    rest = {name: changes.pop(name) for name in ("resume", "callbacks", "validation") if name in changes}
    usual = {"steps": STEPS, "validate_every": EVERY, "devices": devices, "optimizer": {"name": "adam", "lr": 1e-2}}
    found = fit(operator, objective, data, settings(**(usual | changes)), folder, watching=[watch], **rest)
    return watch, operator, found


def fake_round(self: AdaptiveLabels, data: GameData, group: Candidates, rows: Tensor) -> Extremal:
    """Labels of the right starts that were not solved."""
    return fake_solve(data.game, group.x[rows], group.theta[rows])


def apart(one: list[float], other: list[float]) -> float:
    """The largest relative difference of two curves."""
    a, b = torch.tensor(one, dtype=torch.float64), torch.tensor(other, dtype=torch.float64)
    return float(((a - b) / a).abs().max())


@pytest.mark.parametrize(
    ("optimizer", "potential"), [("adam", False), pytest.param("muon", True, marks=pytest.mark.slow)]
)
def test_two_processes_train_as_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, optimizer: str, potential: bool
) -> None:
    """Balanced terms, the hardest points only, points where the policy went, added labels, a clipped gradient, L-BFGS.

    Seven rows of a stream cannot be shared equally. SOAP is not compared: a gradient that differs by 1e-15 changes its
    losses by a per cent in one process too.
    """
    monkeypatch.setattr(AdaptiveLabels, "_solved", fake_round)
    options: dict[str, Any] = {
        "adaptive": Adaptive(1, labels=4, candidates=8, types=2),
        "validate_every": 25,
        "optimizer": {"name": optimizer, "lr": 1e-2},
        "potential": potential,
        "gradient_clip_val": 0.5,
        "polish": 2,
    }
    one, alone, found = trained(tmp_path / "one", 1, **options)
    two, operator, again = trained(tmp_path / "two", 2, **options)
    assert len(one.losses) == len(two.losses) == STEPS
    assert apart(one.losses, two.losses) < 1e-9
    assert found.metrics == pytest.approx(again.metrics, rel=1e-9)
    assert found.best == pytest.approx(again.best, rel=1e-9)
    assert [step.labelled for step in found.rounds] == [step.labelled for step in again.rounds] == [4]
    assert all(map(torch.allclose, alone.state_dict().values(), operator.state_dict().values()))
    assert sorted(path.name for path in (tmp_path / "two").iterdir()) == [BEST, LAST, "previous.ckpt"]


class AtStep(L.Callback):
    """Something happens in one process before a step."""

    def __init__(self, rank: int, step: int, what: str) -> None:
        self.rank, self.step, self.what = rank, step, what

    def on_train_batch_start(self, trainer: L.Trainer, *others: object) -> None:
        if trainer.global_rank == self.rank and trainer.global_step == self.step:
            if self.what == "error":
                raise OSError("the disk is gone")
            os.kill(os.getpid(), getattr(signal, self.what))


def test_an_error_of_another_process_ends_all_and_is_said(tmp_path: Path) -> None:
    with pytest.raises(RankError, match=r"failed, and it ends with it\. OSError: the disk is gone"):
        trained(tmp_path, 2, steps=5, validation=[], callbacks=[AtStep(1, 2, "error")])


@pytest.mark.slow
def test_an_error_of_this_process_is_raised_as_it_is(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="the disk is gone"):
        trained(tmp_path, 2, steps=5, validation=[], callbacks=[AtStep(0, 2, "error")])


@pytest.mark.slow
def test_a_process_that_is_killed_ends_all(tmp_path: Path) -> None:
    with pytest.raises(RankError, match="SIGKILL"):
        trained(tmp_path, 2, steps=5, validation=[], callbacks=[AtStep(1, 2, "SIGKILL")])


@pytest.mark.slow
def test_who_works_alone_is_told_that_another_process_is_gone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rank 0 plays, and asks for nothing that would fail."""
    monkeypatch.setattr(ClosedLoopValidation, "play", lambda *others: time.sleep(100))
    monkeypatch.setattr(together, "GRACE", 0.5)
    began = time.monotonic()
    with pytest.raises(RankError, match="SIGKILL"), interruptible():
        trained(tmp_path, 2, steps=5, validate_every=2, callbacks=[Dies()])
    assert time.monotonic() - began < 60


class Dies(L.Callback):
    """Ends the other process a while after the second step, when it waits for this one."""

    def on_train_batch_start(self, trainer: L.Trainer, *others: object) -> None:
        if trainer.global_rank == 1 and trainer.global_step == 1:
            threading.Timer(2.0, lambda: os.kill(os.getpid(), signal.SIGKILL)).start()


@pytest.mark.slow
@pytest.mark.parametrize("rank", [0, 1])
def test_a_signal_to_any_process_ends_all_after_the_same_step(tmp_path: Path, rank: int) -> None:
    """One checkpoint is left, from which the run goes on as if nothing had been."""
    _, whole, _ = trained(tmp_path / "whole", 2, double=False, steps=8)
    cut = tmp_path / "cut"
    with pytest.raises(Interrupted) as stop, interruptible():
        trained(cut, 2, double=False, steps=8, callbacks=[AtStep(rank, 3, "SIGTERM")])
    assert (str(stop.value), stop.value.between) == ("SIGTERM", True)
    assert [path.name for path in cut.iterdir()] == [LAST]
    step = read_content(cut / LAST)["global_step"]
    assert 3 <= step <= 5
    _, resumed, found = trained(cut, 2, double=False, steps=8, resume=cut / LAST)
    assert found.trainer.global_step == 8
    assert equal(whole, resumed)


@pytest.mark.slow
@pytest.mark.parametrize("optimizer", ["adam", "soap"])
def test_a_resumed_run_is_the_uninterrupted_one(tmp_path: Path, optimizer: str) -> None:
    """Bit by bit on as many devices; to rounding on another number, where the optimizer allows it."""
    chosen: dict[str, Any] = {"optimizer": {"name": optimizer, "lr": 1e-2}, "steps": 8, "validate_every": 4}
    _, whole, found = trained(tmp_path / "whole", 2, **chosen)
    cut = tmp_path / "cut"
    with pytest.raises(PowerCutError):
        trained(cut, 2, **chosen, callbacks=[PowerCut()])
    shutil.copytree(cut, tmp_path / "other")
    _, resumed, again = trained(cut, 2, **chosen, resume=cut / LAST)
    assert equal(whole, resumed)
    assert (found.metrics, found.best) == (again.metrics, again.best)
    if optimizer == "adam":
        _, other, _ = trained(tmp_path / "other", 1, **chosen, resume=tmp_path / "other" / LAST)
        assert all(map(torch.allclose, whole.state_dict().values(), other.state_dict().values()))


class Explodes(LossTerm):
    """A loss that is infinite at the fourth step, by one row of the second process."""

    stream = "interior"

    def residual(self, view: View) -> Tensor:
        once = view.field.value
        return once / 0 if view.step == 3 else once

    def scale(self, view: View) -> Tensor:
        return view.scales.value


@pytest.mark.slow
def test_all_processes_agree_that_a_training_diverges(tmp_path: Path) -> None:
    operator = small_operator()
    objective = Objective({"explodes": Explodes(), "value": ValueDeviation()}, {"explodes": 1.0, "value": 1.0})
    with pytest.raises(DivergedError, match="at step 4: the training diverged"):
        fit(operator, objective, labelled_data(), settings(devices=2), tmp_path, validation=[])
    assert sorted(path.name for path in tmp_path.iterdir()) == [BAD_BATCH, LAST]
    rows = safetensors.torch.load_file(tmp_path / BAD_BATCH)
    assert len(rows["interior.points.tau"]) == 16, "the whole batch"


@pytest.mark.slow
def test_callbacks_that_end_a_training_end_all(tmp_path: Path) -> None:
    stopping: Any = callbacks.get("early_stopping")
    _, _, found = trained(tmp_path, 2, validation=[], callbacks=[stopping(patience=1, min_delta=1e9)])
    assert found.trainer.global_step == 2 * EVERY


@pytest.mark.parametrize(
    ("devices", "sizes", "message"),
    [
        (8, {}, "asks for 8 devices, but a step has 7 rows of data.batch_sizes.terminal"),
        (9, {"terminal": 9}, "asks for 9 devices, but a step has 8 rows of data.batch_sizes.interior"),
    ],
)
def test_more_devices_than_rows_are_refused(devices: int, sizes: dict[str, int], message: str) -> None:
    """Half of the sixteen collocation points count."""
    objective = make_objective({name: {} for name in WEIGHTS}, WEIGHTS, hardest=0.5)
    data = labelled_data()
    data.batch_sizes.update({"terminal": 7} | sizes)
    with pytest.raises(ValueError, match=message):
        check_devices(settings(devices=devices), objective, data)
