"""A long run does not grow: not in memory, not in open files, not on disk."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning as L
import pytest
from lightning.pytorch.loggers import CSVLogger

from hno.losses import make_objective
from hno.training import Settings, fit
from tests.operators.conftest import small_operator
from tests.training.test_fit import labelled_data

STEPS, EVERY = 10_000, 50
PAGE = os.sysconf("SC_PAGE_SIZE")


def resident() -> int:
    """Memory of this process, bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE


class Watch(L.Callback):
    """Writes down what a run takes, every 1,000 steps.

    Args:
        folder: of the run.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.memory, self.handles, self.files, self.disk = list[int](), list[int](), list[int](), list[int]()

    def on_train_batch_end(self, trainer: L.Trainer, *others: Any) -> None:
        if trainer.global_step % 1000 == 1:
            kept = [path for path in self.folder.rglob("*") if path.is_file() and path.suffix != ".csv"]
            self.memory.append(resident())
            self.handles.append(len(os.listdir("/proc/self/fd")))  # noqa: PTH208
            self.files.append(len(kept))
            self.disk.append(sum(path.stat().st_size for path in kept))


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads /proc")
@pytest.mark.parametrize("sampler", [{"box": 0.5, "rollout": 0.5}], ids=["rollouts"])
def test_ten_thousand_steps_with_saving_and_validation_take_no_more_than_two_thousand(
    tmp_path: Path, sampler: Mapping[str, float]
) -> None:
    operator, data, watch = small_operator(), labelled_data(sampler=sampler), Watch(tmp_path)
    weights = {"value": 1.0, "costate": 1.0, "residual": 0.1, "boundary": 0.1}
    settings = Settings(steps=STEPS, validate_every=EVERY, accelerator="cpu", dt=0.5, compile=False)
    loggers = [CSVLogger(tmp_path, "csv", "")]
    fit(
        operator,
        make_objective({name: {} for name in weights}, weights),
        data,
        settings,
        tmp_path,
        loggers=loggers,
        callbacks=[watch],
    )
    assert len(watch.memory) == STEPS // 1000
    assert max(watch.handles[2:]) <= watch.handles[1]
    assert max(watch.files[2:]) <= watch.files[1]
    assert max(watch.disk[2:]) <= 1.02 * watch.disk[1]
    growth = watch.memory[-1] - watch.memory[1]
    print(
        f"1 case: {STEPS} steps, saved and validated {STEPS // EVERY} times; memory {growth / 2**20:+.1f} MiB from "
        f"step 1,000 on, {watch.handles[-1]} open files, {watch.files[-1]} files of {watch.disk[-1] / 1e6:.1f} MB"
    )
    assert growth < 30 * 2**20
