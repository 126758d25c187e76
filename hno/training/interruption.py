"""A training that a signal ends."""

from __future__ import annotations

from pathlib import Path

import lightning as L

from hno.processes import Interrupted, take_back_signals
from hno.training.saving import LAST


class SaveOnSignal(L.Callback):
    """Leave a checkpoint where a signal ends the training between two steps.

    Args:
        folder: of the run.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / LAST

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Take signals back from Lightning, which ends trainings without a checkpoint."""
        take_back_signals()

    def on_exception(self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException) -> None:
        """Save, unless a step is half done."""
        if isinstance(exception, Interrupted) and exception.between and trainer.global_step > 0:
            trainer.save_checkpoint(self.path, weights_only=False)
