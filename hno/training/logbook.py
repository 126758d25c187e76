"""What a run that goes on adds to."""

from __future__ import annotations

import math
import time
from typing import Any, final

import lightning as L


@final
class Logbook(L.Callback):
    """The time spent, and losses and errors of the last step, which are saved with every checkpoint.

    The last step is validated, and so saved, like those that it is time for.
    """

    def __init__(self) -> None:
        self.before, self.began = 0.0, time.perf_counter()
        self.metrics: dict[str, float] = {}

    @property
    def seconds(self) -> float:
        """Time spent on the run up to now, s."""
        return self.before + time.perf_counter() - self.began

    def on_train_batch_start(self, trainer: L.Trainer, *others: Any) -> None:
        """Lightning counts the steps of loggers apart, and one too few after some checkpoints."""
        trainer.fit_loop.epoch_loop._batches_that_stepped = trainer.global_step

    def on_train_batch_end(self, trainer: L.Trainer, *others: Any) -> None:
        """End with a validation."""
        trainer.should_stop |= trainer.global_step == trainer.max_steps

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Take note, and let loggers write what they have before the checkpoint is."""
        found = {name: float(value) for name, value in trainer.callback_metrics.items()}
        named = {name: value for name, value in found.items() if name.startswith(("loss/", "val/"))}
        self.metrics = {name: value for name, value in named.items() if not math.isnan(value)}
        for logger in trainer.loggers:
            logger.save()

    def state_dict(self) -> dict[str, Any]:
        """What the next process adds to."""
        return {"seconds": self.seconds, "metrics": self.metrics}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Add to it."""
        self.before, self.began = float(state_dict["seconds"]), time.perf_counter()
        self.metrics = {str(name): float(value) for name, value in state_dict["metrics"].items()}
