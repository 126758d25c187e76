"""Callbacks of Lightning by name: configurations choose among these, and execute nothing else."""

from __future__ import annotations

import importlib.util
from typing import Literal

import lightning as L
from lightning.pytorch.callbacks import (
    Callback,
    DeviceStatsMonitor,
    EarlyStopping,
    LearningRateMonitor,
    RichModelSummary,
)

from hno.registry import Registry

callbacks: Registry[Callback] = Registry("callback", "hno.training", base="lightning.pytorch.callbacks:Callback")
"""Callbacks: subclasses of Lightning's, or functions (**options) that build one."""


class _EarlyStopping(EarlyStopping):
    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """A run that it had ended is not trained on."""
        trainer.should_stop |= self.wait_count >= self.patience


@callbacks.register("early_stopping")
def early_stopping(
    monitor: str = "val/costate_error", patience: int = 5, min_delta: float = 0.0, mode: str = "min"
) -> Callback:
    """End the training once a number no longer improves.

    Args:
        monitor: of those that metrics.csv holds after a validation.
        patience: validations without improvement.
        min_delta: what counts as one.
        mode: "min" or "max".
    """
    return _EarlyStopping(monitor, min_delta, patience, mode=mode)


@callbacks.register("learning_rate")
def learning_rate(momentum: bool = False) -> Callback:
    """Log the learning rate.

    Args:
        momentum: log the optimiser's momentum too.
    """
    interval: Literal["step"] = "step"
    return LearningRateMonitor(logging_interval=interval, log_momentum=momentum)


@callbacks.register("device_stats")
def device_stats(cpu: bool = False) -> Callback:
    """Log memory and use of the accelerator.

    Args:
        cpu: of the processor too, for which psutil is needed.

    Raises:
        ValueError: psutil is not installed.
    """
    if cpu and importlib.util.find_spec("psutil") is None:
        raise ValueError("callbacks.device_stats.cpu=true needs psutil: pip install psutil.")
    return DeviceStatsMonitor(cpu_stats=cpu)


@callbacks.register("model_summary")
def model_summary(depth: int = 3) -> Callback:
    """Print the layers and their sizes.

    Args:
        depth: of nested modules.
    """
    return RichModelSummary(max_depth=depth)
