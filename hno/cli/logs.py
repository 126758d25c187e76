"""Loggers."""

from __future__ import annotations

import importlib.util
import inspect
import logging
import os
import shlex
import socket
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

import torch
from lightning.pytorch.callbacks import Callback, LearningRateMonitor
from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger

from hno.cli import pages
from hno.cli.curve import CurveLogger
from hno.cli.schema import validated
from hno.cli.settings import EvaluateSettings, LoggerSettings, TrainSettings
from hno.report.runs import METRICS, RESULTS

log = logging.getLogger(__name__)
MODES = ("online", "offline", "disabled", "shared", "dryrun", "run")
"""What W&B takes for WANDB_MODE."""


def use_threads(count: int | None) -> None:
    """Let torch use so many threads; None for its own choice."""
    if count is not None:
        torch.set_num_threads(count)


def loggers(settings: TrainSettings | EvaluateSettings, folder: Path, first: int = 0) -> list[Logger]:
    """The chosen loggers, each once; they keep what they have of steps before the first one.

    Raises:
        RuntimeError: the package of a logger is not installed.
        ValueError: W&B cannot run as asked for.
    """
    made: list[Logger] = []
    chosen = settings.logger
    if chosen is None:
        return made
    for name in dict.fromkeys(chosen.names):
        if name == "csv":
            made.append(CurveLogger(folder / METRICS, first))
        elif name == "tensorboard":
            try:
                made.append(TensorBoardLogger(folder, "", "tensorboard", default_hp_metric=False, purge_step=first))
            except ModuleNotFoundError as error:
                message = "TensorBoard is not installed: `pip install tensorboard`, or choose logger=csv."
                raise RuntimeError(message) from error
        elif importlib.util.find_spec("wandb") is None:
            log.info("W&B is not installed: metrics go to %s alone. `pip install wandb` adds it.", METRICS)
        elif (mode := wandb_mode(chosen.mode)) != "disabled":
            kind = "train" if isinstance(settings, TrainSettings) else "evaluate"
            made.append(_wandb(chosen, folder, mode, settings.model_dump(), kind))
        else:
            log.info("W&B is switched off: metrics go to %s alone.", METRICS)
    return made or [CurveLogger(folder / METRICS, first)] * bool(chosen.names)


def _wandb(chosen: LoggerSettings, folder: Path, mode: str, config: Mapping[str, Any], kind: str) -> Logger:
    """The run of the folder, if W&B left one there: it ends the names of its own folders with the run's id.

    Args:
        chosen: project and mode.
        folder: of the run.
        mode: what the mode comes to.
        config: all settings, with tags and notes.
        kind: the job type, the command's name.
    """
    os.environ.setdefault("WANDB_SILENT", "true")  # what it says is in its files, and here where those are
    known = sorted(folder.glob("wandb/*run-*-*"))
    logger = WandbLogger(
        name=folder.name, save_dir=folder, mode=mode, project=chosen.project, group=folder.parent.name,
        config=dict(config), id=known[-1].name.rpartition("-")[2] if known else None, resume="allow",
        job_type=kind, tags=config.get("tags") or None, notes=config.get("notes"),
    )  # fmt: skip
    run = logger.experiment
    here = shlex.quote(str(Path(run.dir).parent))
    log.info("W&B run: %s", run.url if mode == "online" else f"{here}; `wandb sync` uploads it.")
    return logger


def rates(made: Sequence[Logger], chosen: Sequence[Callback]) -> list[Callback]:
    """What tells W&B the learning rate at every step that it is told the losses of, unless it is chosen anyway."""
    there = any(isinstance(one, LearningRateMonitor) for one in chosen)
    return [LearningRateMonitor("step")] if not there and any(isinstance(one, WandbLogger) for one in made) else []


def refuse_wandb(config: Mapping[str, Any], results: Mapping[str, Any], folder: Path, kind: str) -> None:
    """Make a refused job a W&B run with the reason in its summary, where its configuration asks for W&B.

    Args:
        config: as composed; what is refused in it may be anything but the logger.
        results: content of results.json.
        folder: where it lies.
        kind: the job type, the command's name.
    """
    try:
        chosen = validated(LoggerSettings, config.get("logger") or {"names": [], "project": "none", "mode": "auto"})
        if "wandb" not in chosen.names or importlib.util.find_spec("wandb") is None:
            return
        check_wandb()
        if (mode := wandb_mode(chosen.mode)) != "disabled":
            _wandb(chosen, folder, mode, config, kind)
            finish_wandb(results, folder)
    except Exception as error:  # the job has its reason; this is about where else it is told
        log.warning("The refused job is no run of W&B: %s", error)


def finish_wandb(results: Mapping[str, Any], folder: Path) -> None:
    """Close the W&B run of this process, if there is one, however the run ended: the next job gets its own.

    The page, the results, what was played and the checkpoint that counts are its artifact.

    Args:
        results: content of results.json.
        folder: where it lies.
    """
    wandb = sys.modules.get("wandb")  # of a logger that used it
    if wandb is None or wandb.run is None:
        return
    wandb.run.summary.update({name: results[name] for name in ("status", "reason")})
    try:
        pages.write(folder)
        wandb.run.log_artifact(_artifact(wandb, results, folder))
    except Exception as error:  # what W&B refuses costs no run its results
        log.warning("W&B did not take the files of the run: %s", error)
    wandb.finish(exit_code=int(results["status"] not in ("finished", "pruned")))


def _artifact(wandb: Any, results: Mapping[str, Any], folder: Path) -> Any:
    made = wandb.Artifact(f"run-{wandb.run.id}", "run")
    models = results.get("models", [results])
    kept = [model.get(key) for model in models for key in ("checkpoint", "episodes", "paths", "outcomes", "landscape")]
    beside = sorted(folder.glob(f"{Path(pages.PAGE).stem}_files/*.js"))
    for name in dict.fromkeys([pages.PAGE, RESULTS, *kept]):
        if name is not None and (folder / name).is_file():
            made.add_file(str(folder / name))
    for path in beside:
        made.add_file(str(path), str(path.relative_to(folder)))
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
    if choice == "disabled":
        return choice
    import wandb

    has_key, server = _has_key(), wandb.Settings().base_url
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


def _has_key() -> bool:
    """Whether W&B knows a key, without asking for one."""
    import wandb

    if os.environ.get("WANDB_API_KEY"):
        return True
    if "prompt" in inspect.signature(wandb.login).parameters:
        return bool(wandb.login(prompt=False, verify=False))
    return bool(wandb.api.api_key)  # before 0.2x


def _reachable(url: str) -> bool:
    parts = urlparse(url)
    try:
        with socket.create_connection((parts.hostname or "", parts.port or 443), timeout=3.0):
            return True
    except OSError:
        return False
