"""What watches a training run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import ModelCheckpoint


class DivergedError(RuntimeError):
    """The training loss is no longer finite."""


class StopOnDivergence(L.Callback):
    """Raise as soon as the loss, or at the end a weight, is not finite.

    The test looks every `every` steps, because it waits for the device.

    Args:
        every: steps between tests.
    """

    def __init__(self, every: int = 50) -> None:
        self.every = every

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Test the loss of this step."""
        last = trainer.global_step == trainer.max_steps
        if (trainer.global_step % self.every == 0 or last) and not bool(torch.isfinite(outputs["loss"])):
            raise DivergedError(
                f"The loss is {float(outputs['loss'])} at step {trainer.global_step}: the training diverged. {_ADVICE}"
            )

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Test the weights, which the last step changed after its loss."""
        if not all(bool(weights.isfinite().all()) for weights in pl_module.parameters()):
            raise DivergedError(f"The last step left weights that are not finite: the training diverged. {_ADVICE}")


_ADVICE = "Lower optimizer.lr or set trainer.gradient_clip_val."


def checkpoints(folder: Path, every: int) -> ModelCheckpoint:
    """Keep `last.ckpt` in the folder, written every so many steps."""
    return ModelCheckpoint(
        dirpath=folder,
        filename="last",
        every_n_train_steps=every,
        save_on_train_epoch_end=False,
        enable_version_counter=False,
    )
