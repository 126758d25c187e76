"""Ends a training that diverges."""

from __future__ import annotations

import math
from typing import Any

import lightning as L
import torch

ERROR = "val/costate_error"


class DivergedError(RuntimeError):
    """The loss, the error on held-out labels or a weight is no longer sound; `what` says which."""

    def __init__(self, what: str) -> None:
        super().__init__(f"{what}: the training diverged. Lower optimizer.lr or set trainer.gradient_clip_val.")


class StopOnDivergence(L.Callback):
    """Raise as soon as the loss, or at the end a weight, is not finite, or the error on held-out labels has exploded.

    The loss is tested every `every` steps, because the test waits for the device; the error at each validation.

    Args:
        every: steps between tests.
        growth: how many times its smallest value so far the error may become.
    """

    def __init__(self, every: int = 50, growth: float = 10.0) -> None:
        self.every, self.growth = every, growth
        self.smallest = math.inf

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Test the loss of this step."""
        last = trainer.global_step == trainer.max_steps
        if (trainer.global_step % self.every == 0 or last) and not bool(torch.isfinite(outputs["loss"])):
            raise DivergedError(f"The loss is {float(outputs['loss'])} at step {trainer.global_step}")

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Test the error of costates on held-out labels."""
        error = float(trainer.callback_metrics.get(ERROR, 0.0))
        self.smallest = min(self.smallest, error)
        if not (math.isfinite(error) and error <= self.growth * self.smallest):
            was = f"; it was {self.smallest:.3g}" if self.smallest < math.inf else ""
            raise DivergedError(f"The error of costates is {error:.3g} at step {trainer.global_step}{was}")

    def state_dict(self) -> dict[str, Any]:
        """The smallest error so far."""
        return {"smallest": self.smallest}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore it."""
        self.smallest = state_dict["smallest"]

    def on_exception(self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException) -> None:
        """Say what it means that an optimiser cannot factorise its statistics: a gradient was not finite."""
        if isinstance(exception, torch.linalg.LinAlgError):  # type: ignore[attr-defined]  # public, not in __all__
            raise DivergedError(f"The optimiser failed at step {trainer.global_step}") from exception

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Test the weights, which the last step changed after its loss."""
        if not all(bool(weights.isfinite().all()) for weights in pl_module.parameters()):
            raise DivergedError("The last step left weights that are not finite")
