"""Loggers, progress and where messages go."""

from __future__ import annotations

import logging
import math
import os
import socket
import sys
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

import lightning as L
import torch
import wandb
from lightning.pytorch.callbacks import ProgressBar, RichProgressBar
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger, WandbLogger

from hno.cli.schema import TrainSettings
from hno.data.labels import Progress, Report

log = logging.getLogger(__name__)


def send_lightning_to_hydra() -> None:
    """Let Lightning's messages and Python's warnings reach Hydra's handlers, console and file."""
    logging.captureWarnings(True)
    warnings.formatwarning = lambda message, category, *_, **__: f"{category.__name__}: {message}"
    warnings.filterwarnings("ignore", message=".*exists and is not empty")  # results.json is there first, on purpose
    warnings.filterwarnings("ignore", message=".*isinstance.treespec, LeafSpec.")  # Lightning's own, from torch 2.13 on
    warnings.filterwarnings("ignore", message=".*does not have many workers")  # batches are made in memory
    logging.getLogger("lightning.pytorch.utilities.rank_zero").addFilter(lambda line: "Tip:" not in line.getMessage())
    for name in ("lightning", "lightning.pytorch", "lightning.fabric"):
        logger = logging.getLogger(name)
        logger.handlers.clear()
        logger.propagate = True


class LoggerMissingError(RuntimeError):
    """The optional package of a logger is not installed."""


def use_threads(count: int | None) -> None:
    """Let torch use so many threads; None for its own choice."""
    if count is not None:
        torch.set_num_threads(count)


def loggers(settings: TrainSettings, folder: Path) -> list[Logger]:
    """The chosen loggers, each once.

    Raises:
        LoggerMissingError: the package of a logger is not installed.
        ValueError: W&B cannot run as asked for.
    """
    made = [LOGGERS[name](settings, folder) for name in dict.fromkeys(settings.logger.names)]
    return [logger for logger in made if logger is not None]


def _csv(settings: TrainSettings, folder: Path) -> Logger:
    return CSVLogger(folder, name="", version="csv")


def _tensorboard(settings: TrainSettings, folder: Path) -> Logger:
    try:
        return TensorBoardLogger(folder, name="", version="tensorboard", default_hp_metric=False)
    except ModuleNotFoundError as error:
        message = "TensorBoard is not installed: `pip install tensorboard`, or choose logger=csv."
        raise LoggerMissingError(message) from error


def _wandb(settings: TrainSettings, folder: Path) -> Logger | None:
    mode = wandb_mode(settings.logger.mode)
    if mode == "disabled":
        return None
    return WandbLogger(
        project=settings.logger.project,
        group=folder.parent.name,
        name=folder.name,
        save_dir=folder,
        mode=mode,
        config=settings.model_dump(),
    )


LOGGERS: Mapping[str, Callable[[TrainSettings, Path], Logger | None]] = {
    "csv": _csv,
    "tensorboard": _tensorboard,
    "wandb": _wandb,
}
"""What `logger.names` may hold."""


def finish_wandb(results: Mapping[str, Any]) -> None:
    """Close the W&B run of this process, if there is one, however the run ended: the next job gets its own.

    Args:
        results: content of results.json.
    """
    if wandb.run is not None:
        wandb.run.summary.update({name: results[name] for name in ("status", "reason")})
    wandb.finish(exit_code=int(results["status"] != "finished"))


def wandb_mode(choice: str) -> str:
    """Resolve "auto": online with a key and a reachable server, otherwise offline, said in one line.

    Raises:
        ValueError: "online" without a key.
    """
    choice = os.environ.get("WANDB_MODE", choice) if choice == "auto" else choice
    has_key = bool(os.environ.get("WANDB_API_KEY") or wandb.api.api_key)
    if choice == "online" and not has_key:
        raise ValueError("W&B has no API key to run online: `wandb login`, set WANDB_API_KEY, or use logger.mode=auto.")
    if choice != "auto":
        return choice
    settings = wandb.Settings()
    if not has_key:
        log.info("W&B runs offline: no API key. `wandb login` or WANDB_API_KEY makes it online.")
        return "offline"
    if not _reachable(settings.base_url):
        log.info("W&B runs offline: %s cannot be reached. `wandb sync` uploads the run later.", settings.base_url)
        return "offline"
    return "online"


def _reachable(url: str, seconds: float = 3.0) -> bool:
    parts = urlparse(url)
    try:
        with socket.create_connection((parts.hostname or "", parts.port or 443), timeout=seconds):
            return True
    except OSError:
        return False


def label_progress(every: float = 10.0) -> Report:
    """A function that logs how many labels are solved, at most one line every so many seconds."""
    began = last = time.monotonic()

    def say(progress: Progress) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= every or progress.done == progress.total:
            last = now
            failed = f", {progress.done - progress.converged} failed" if progress.converged < progress.done else ""
            log.info("labels: %d of %d in %.0f s%s", progress.done, progress.total, now - began, failed)

    return say


class StepBar(RichProgressBar):
    """A live bar over the steps of the run; epochs mean nothing here."""

    @property
    def total_train_batches(self) -> int:
        """Steps of the run."""
        return self.trainer.max_steps

    def _get_train_description(self, current_epoch: int) -> str:
        return "training"

    def get_metrics(
        self, trainer: L.Trainer, pl_module: L.LightningModule
    ) -> dict[str, int | str | float | dict[str, float]]:
        """Losses, without the logger's version."""
        return {name: value for name, value in super().get_metrics(trainer, pl_module).items() if name != "v_num"}


def progress_bar() -> ProgressBar | None:
    """A live bar on a terminal, nothing elsewhere."""
    return StepBar() if sys.stdout.isatty() else None


class StepLines(L.Callback):
    """One line every so many steps, where there is no terminal.

    Args:
        every: steps between lines.
    """

    def __init__(self, every: int) -> None:
        self.every = every

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Print the losses."""
        if trainer.global_step % self.every == 0:
            found = [(name, float(value)) for name, value in sorted(trainer.callback_metrics.items())]
            losses = ", ".join(f"{k} {v:.4g}" for k, v in found if k == "loss/total" or not math.isnan(v))
            log.info("step %d of %d: %s", trainer.global_step, trainer.max_steps, losses)
