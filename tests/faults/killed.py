"""Trainings in processes of their own that are killed at chosen or random moments."""

from __future__ import annotations

import csv
import json
import multiprocessing
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

import lightning as L
import torch

from hno.cli import evaluate, pages
from hno.cli.main import main
from hno.training.fit import Logbook
from hno.training.saving import BEST, LAST, read_content
from tests.cli.conftest import SMOKE

PROCESSES = multiprocessing.get_context("forkserver")
PROCESSES.set_forkserver_preload([__name__])
STEPS, EVERY = 110, 30
"""Of a run with a supervised phase, a hybrid one, and another supervised one; rows are logged at 50 and 100 steps."""
TINY = (
    *SMOKE, "data.trajectories=4", f"trainer.max_steps={STEPS}", f"trainer.validate_every={EVERY}",
    "trainer.print_every=1000", "data.pretrain=0.3", "data.widening=0.2", "data.finish=0.3",
)  # fmt: skip


class Moment(NamedTuple):
    """When a signal ends a process.

    So many seconds after a hook of the training, in the step after so many; at once where `delay` is 0.
    """

    step: int
    hook: str = "on_train_batch_start"
    delay: float = 0.0
    signal: int = signal.SIGKILL
    """As a power cut would, or one that can be answered."""

    def end(self) -> None:
        """End this process."""
        os.kill(os.getpid(), self.signal)


def train(*words: str, moment: Moment | None = None) -> int:
    """Run `hno train` in a process of its own; its exit code, -9 after a kill."""
    process = PROCESSES.Process(target=_train, args=(words, moment))
    process.start()
    process.join(300)
    assert process.exitcode is not None
    return process.exitcode


def _train(words: tuple[str, ...], moment: Moment | None) -> None:
    torch.set_num_threads(1)
    evaluate.draw_typical = lambda *others: None
    pages.write = lambda folder: Path(folder)
    if moment is not None:
        _arm(moment)
    raise SystemExit(main(["train", *words]))


def _arm(moment: Moment) -> None:
    original = getattr(Logbook, moment.hook, None)

    def hook(self: Logbook, trainer: L.Trainer, *others: Any) -> None:
        if trainer.global_step == moment.step:
            if not moment.delay:
                moment.end()
            threading.Thread(target=lambda: (time.sleep(moment.delay), moment.end()), daemon=True).start()
        if original is not None:
            original(self, trainer, *others)

    setattr(Logbook, moment.hook, hook)


def results(folder: Path) -> dict[str, Any]:
    """What results.json says."""
    content: dict[str, Any] = json.loads((folder / "results.json").read_text())
    return content


def curve(folder: Path) -> list[dict[str, str]]:
    """Rows of the curve, without times."""
    with (folder / "csv" / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    return [{name: cell for name, cell in row.items() if not name.startswith("seconds/")} for row in rows]


def check_equal(folder: Path, whole: Path) -> None:
    """A run is equal to another but for times and names of folders: weights, optimizer, loops, curves, results."""
    assert curve(folder) == curve(whole)
    for name in (BEST, LAST):
        ours, theirs = (timeless(read_content(path / name)) for path in (folder, whole))
        assert_same(ours, theirs, name)
    ours, theirs = results(folder), results(whole)
    assert ours["seconds"].keys() == theirs["seconds"].keys()
    for found in (ours, theirs):
        for name in ("seconds", "resumed"):
            found.pop(name, None)
        for each in found.get("rounds", []):
            each.pop("seconds")
    assert_same(ours, theirs, "results")
    assert (folder / "episodes.json").read_bytes() == (whole / "episodes.json").read_bytes()


def timeless(content: dict[str, Any]) -> dict[str, Any]:
    """A checkpoint without times and paths."""
    states = {name.partition("{")[0]: state for name, state in content["callbacks"].items()}
    states.pop("ModelCheckpoint")
    for name in ("seconds", "solving"):
        for state in states.values():
            state.pop(name, None)
    for each in states.get("AdaptiveLabels", {}).get("done", []):
        each.pop()
    return {**content, "callbacks": states}


def assert_same(one: Any, other: Any, where: str) -> None:
    """Nested containers are equal, tensors bit by bit."""
    if isinstance(one, torch.Tensor):
        assert torch.equal(one, other), where
    elif isinstance(one, dict):
        assert one.keys() == other.keys(), where
        for key in one:
            assert_same(one[key], other[key], f"{where}.{key}")
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(other), where
        for number, pair in enumerate(zip(one, other, strict=True)):
            assert_same(*pair, f"{where}[{number}]")
    else:
        assert one == other or (one != one and other != other), where
