"""Loggers, progress and where messages go."""

from __future__ import annotations

import logging
import math
import os
import socket
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

import lightning as L
import torch
import wandb
from lightning.pytorch.callbacks import LearningRateMonitor, RichProgressBar
from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger

from hno.cli import pages
from hno.cli.curve import CurveLogger
from hno.cli.settings import TrainSettings
from hno.data.labels import Progress, Report
from hno.report.runs import METRICS, RESULTS

log = logging.getLogger(__name__)
MODES = ("online", "offline", "disabled", "shared", "dryrun", "run")
"""What W&B takes for WANDB_MODE."""


def send_lightning_to_hydra() -> None:
    """Let Lightning's messages and Python's warnings reach Hydra's handlers, console and file."""
    logging.captureWarnings(True)
    warnings.formatwarning = lambda message, category, *_, **__: f"{category.__name__}: {message}"
    for name in ("lightning", "lightning.pytorch", "lightning.fabric"):
        logger = logging.getLogger(name)
        logger.handlers.clear()
        logger.propagate = True


def use_threads(count: int | None) -> None:
    """Let torch use so many threads; None for its own choice."""
    if count is not None:
        torch.set_num_threads(count)


def loggers(settings: TrainSettings, folder: Path, first: int = 0) -> list[Logger]:
    """The chosen loggers, each once; they keep what they have of steps before the first one.

    Raises:
        RuntimeError: the package of a logger is not installed.
        ValueError: W&B cannot run as asked for.
    """
    made: list[Logger] = []
    for name in dict.fromkeys(settings.logger.names):
        if name == "csv":
            made.append(CurveLogger(folder / METRICS, first))
        elif name == "tensorboard":
            try:
                made.append(TensorBoardLogger(folder, "", "tensorboard", default_hp_metric=False, purge_step=first))
            except ModuleNotFoundError as error:
                message = "TensorBoard is not installed: `pip install tensorboard`, or choose logger=csv."
                raise RuntimeError(message) from error
        elif (mode := wandb_mode(settings.logger.mode)) != "disabled":
            made.append(_wandb(settings, folder, mode))
    return made


def _wandb(settings: TrainSettings, folder: Path, mode: str) -> Logger:
    """The run of the folder, if W&B left one there: it ends the names of its own folders with the run's id."""
    known = sorted(folder.glob("wandb/*run-*-*"))
    return WandbLogger(
        name=folder.name, save_dir=folder, mode=mode, project=settings.logger.project, group=folder.parent.name,
        job_type="train",
        config=settings.model_dump(), id=known[-1].name.rpartition("-")[2] if known else None, resume="allow",
    )  # fmt: skip


def rates(made: Sequence[Logger]) -> list[L.Callback]:
    """What tells W&B the learning rate at every step that it is told the losses of."""
    return [LearningRateMonitor("step")] if any(isinstance(one, WandbLogger) for one in made) else []


def finish_wandb(results: Mapping[str, Any], folder: Path) -> None:
    """Close the W&B run of this process, if there is one, however the run ended: the next job gets its own.

    The page, the results, what was played and the checkpoint that counts are its artifact.

    Args:
        results: content of results.json.
        folder: where it lies.
    """
    if wandb.run is not None:
        wandb.run.summary.update({name: results[name] for name in ("status", "reason")})
        try:
            pages.write(folder)
            wandb.run.log_artifact(_artifact(results, folder))
        except Exception as error:  # what W&B refuses costs no run its results
            log.warning("W&B did not take the files of the run: %s", error)
    wandb.finish(exit_code=int(results["status"] != "finished"))


def _artifact(results: Mapping[str, Any], folder: Path) -> wandb.Artifact:
    made = wandb.Artifact(f"run-{wandb.run.id if wandb.run else folder.name}", "run")
    names = [pages.PAGE, RESULTS, *(results.get(key) for key in ("checkpoint", "episodes", "paths", "outcomes"))]
    for name in names:
        if name is not None and (folder / name).is_file():
            made.add_file(str(folder / name))
    return made


def check_wandb() -> None:
    """Take an empty WANDB_MODE for none, which W&B does not.

    Raises:
        ValueError: W&B has no such mode.
    """
    mode = os.environ.get("WANDB_MODE")
    if not mode:
        os.environ.pop("WANDB_MODE", None)
    elif mode not in MODES:
        raise ValueError(f"WANDB_MODE must be {', '.join(MODES)} or unset; got {mode!r}. Or choose logger=csv.")


def wandb_mode(choice: str) -> str:
    """Resolve "auto": online with a key and a reachable server, otherwise offline, said in one line.

    Raises:
        ValueError: "online" without a key.
    """
    choice = os.environ.get("WANDB_MODE", choice) if choice == "auto" else choice
    has_key, server = bool(os.environ.get("WANDB_API_KEY") or wandb.api.api_key), wandb.Settings().base_url
    if choice == "online" and not has_key:
        raise ValueError("W&B has no API key to run online: `wandb login`, set WANDB_API_KEY, or use logger.mode=auto.")
    if choice != "auto":
        return choice
    if not has_key:
        log.info("W&B runs offline: no API key. `wandb login` or WANDB_API_KEY makes it online.")
    elif not _reachable(server):
        log.info("W&B runs offline: %s cannot be reached. `wandb sync` uploads the run later.", server)
    else:
        return "online"
    return "offline"


def _reachable(url: str) -> bool:
    parts = urlparse(url)
    try:
        with socket.create_connection((parts.hostname or "", parts.port or 443), timeout=3.0):
            return True
    except OSError:
        return False


def label_progress(say: Callable[[str], None] = log.info, every: float = 10.0) -> Report:
    """A function that says how many labels are solved, at most one line every so many seconds."""
    began = last = time.monotonic()

    def report(progress: Progress) -> None:
        nonlocal last
        now, left = time.monotonic(), progress.total - progress.done
        if now - last >= every or not left:
            last = now
            counts = f"{progress.converged} converged, {progress.done - progress.converged} failed"
            rate = progress.done / max(now - began, 1e-9)
            seconds = left / max(rate, 1e-9)
            say(f"labels: {progress.done} of {progress.total}: {counts}, {rate:.1f}/s, {seconds:.0f} s left")

    return report


class StepBar(RichProgressBar):
    """A live bar over the steps of the run; epochs mean nothing here."""

    @property
    def total_train_batches(self) -> int:
        """Steps of the run."""
        return self.trainer.max_steps

    def _get_train_description(self, current_epoch: int) -> str:
        return "training"

    def get_metrics(self, *run: Any) -> dict[str, Any]:
        """Losses, without the logger's version."""
        return {name: value for name, value in super().get_metrics(*run).items() if name != "v_num"}


class StepLines(L.Callback):
    """One line every so many steps, where there is no terminal.

    Args:
        every: steps between lines.
    """

    def __init__(self, every: int) -> None:
        self.every = every

    def on_train_batch_end(self, trainer: L.Trainer, *others: Any) -> None:
        """Print the losses."""
        if trainer.global_step % self.every == 0:
            found = [(name, float(value)) for name, value in sorted(trainer.callback_metrics.items())]
            losses = ", ".join(f"{k} {v:.4g}" for k, v in found if k == "loss/total" or not math.isnan(v))
            log.info("step %d of %d: %s", trainer.global_step, trainer.max_steps, losses)
