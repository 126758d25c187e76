"""A training that a signal ends."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import lightning as L

from hno.data import GameData
from hno.processes import Interrupted, stop_if_asked, take_back_signals
from hno.training.ranks import Ranks
from hno.training.saving import LAST


class SaveOnSignal(L.Callback):
    """Leave a checkpoint where a signal ends the training between two steps, and before a step with long work after it.

    What a signal breaks off after that step, when it does not end in time, lacks the step alone.

    Args:
        folder: of the run.
        long: whether long work follows a step, by its number.
        ranks: the processes of the training; a signal to any of them ends all after the same step.
    """

    def __init__(self, folder: Path, long: Callable[[int], bool], ranks: Ranks = Ranks()) -> None:
        self.path, self.long, self.ranks, self.saved = folder / LAST, long, ranks, 0

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Take signals back from Lightning, which ends trainings without a checkpoint."""
        self.saved = trainer.global_step
        _call_between_steps(trainer, partial(self.between, trainer))
        take_back_signals()

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """The data may go on to another training."""
        _call_between_steps(trainer, stop_if_asked)

    def between(self, trainer: L.Trainer) -> None:
        """Save what would take long to come to again; the step before is complete, its losses are logged."""
        stop_if_asked(self.ranks.largest)
        if trainer.global_step > self.saved and self.long(trainer.global_step + 1):
            self._save(trainer)

    def on_exception(self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException) -> None:
        """Save, unless a step is half done."""
        if isinstance(exception, Interrupted) and exception.between and trainer.global_step > 0:
            self._save(trainer)
        _call_between_steps(trainer, stop_if_asked)

    def _save(self, trainer: L.Trainer) -> None:
        self.saved = trainer.global_step
        trainer.save_checkpoint(self.path, weights_only=False)


def _call_between_steps(trainer: L.Trainer, between: Callable[[], None]) -> None:
    data = getattr(trainer, "datamodule", None)
    if isinstance(data, GameData):
        data.between = between
