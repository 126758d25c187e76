"""Lightning's trainer: what of it may be chosen, and what a training of ours decides by itself."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import ModelCheckpoint, ProgressBar
from lightning.pytorch.loggers import Logger
from lightning.pytorch.profilers import AdvancedProfiler, Profiler, PyTorchProfiler, SimpleProfiler

from hno.data import GameData
from hno.losses import Objective
from hno.registry import UnknownNameError, unknown_name
from hno.training.divergence import StopOnDivergence
from hno.training.ranks import Here, Ranks, Together
from hno.training.saving import LAST, CheckpointFiles
from hno.training.settings import Settings

PROFILERS: Mapping[str, type[Profiler]] = {
    "simple": SimpleProfiler, "advanced": AdvancedProfiler, "pytorch": PyTorchProfiler,
}  # fmt: skip
"""Each writes a file, or files, named profile into the run's folder."""
STRATEGIES = ("auto", "single_device", "ddp")
_STEPS = "a training counts steps: trainer.max_steps and trainer.validate_every"
_BATCHES = "every batch is a function of seed and step: choose data.batch_sizes"
_NO_TEST = "a trainer of ours only fits; the evaluation is under `evaluation`"
CONTROLLED: Mapping[str, str] = {
    "logger": "choose it with logger=csv, tensorboard or wandb",
    "callbacks": "choose them with callbacks=<name> or callbacks.<name>={...}",
    "fast_dev_run": "it would keep neither checkpoints nor metrics: take debug=fast",
    "overfit_batches": "take debug=overfit",
    "barebones": "it would keep no checkpoints: profiler=simple shows where time goes",
    "max_epochs": _STEPS,
    "min_epochs": _STEPS,
    "val_check_interval": _STEPS,
    "check_val_every_n_epoch": _STEPS,
    "num_sanity_val_steps": _STEPS,
    "limit_train_batches": _STEPS,
    "limit_val_batches": "validation is one batch: choose data.validation and validation.starts",
    "limit_test_batches": _NO_TEST,
    "limit_predict_batches": _NO_TEST,
    "accumulate_grad_batches": _BATCHES,
    "use_distributed_sampler": "every device takes its share of every batch",
    "num_nodes": "a run trains on one machine: give each a run of its own, with launcher=slurm or ray",
    "reload_dataloaders_every_n_epochs": _BATCHES,
    "enable_checkpointing": "checkpoints are what a run goes on from and is judged by",
    "enable_progress_bar": "there is one on a terminal, and lines elsewhere: trainer.print_every",
    "default_root_dir": "the run's folder is --to",
    "inference_mode": "validation differentiates the value",
    "plugins": "checkpoints are written by one of ours",
}
"""Arguments of Lightning's trainer that may not be given, and what to do instead."""
OWN = ("accelerator", "devices", "precision", "max_steps", "gradient_clip_val", "strategy", "profiler")
"""Those that `Settings` has fields for."""


def check_arguments(given: Mapping[str, Any], known: Sequence[str] = ()) -> None:
    """Refuse entries that are no arguments of Lightning's trainer, or such that a training of ours decides.

    Args:
        given: names and values.
        known: other names that messages list.

    Raises:
        UnknownNameError: there is no such argument.
        ValueError: it is `CONTROLLED`.
    """
    free = sorted(set(inspect.signature(L.Trainer).parameters) - set(CONTROLLED) - set(OWN))
    for name in given:
        if name in CONTROLLED:
            raise ValueError(f"{name} of Lightning's trainer cannot be given: {CONTROLLED[name]}.")
        if name not in free:
            text = unknown_name("configuration key", name, sorted({*known, *free}))
            raise UnknownNameError(f"{name} does not exist. {text}")


def profiler(name: str | None, folder: Path) -> Profiler | None:
    """Lightning's profiler of a name, which writes into a folder.

    Raises:
        ValueError: there is none of this name.
    """
    if name is None:
        return None
    if name not in PROFILERS:
        raise ValueError(f"trainer.profiler must be {', '.join(PROFILERS)} or null; got {name!r}.")
    return PROFILERS[name](dirpath=folder, filename="profile")


def device_count(settings: Settings) -> int:
    """How many devices a training asks for.

    Raises:
        ValueError: there is no such accelerator, or `single_device` is to be several.
    """
    found = L.Trainer(
        accelerator=settings.accelerator, devices=settings.devices, logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, plugins=[Here()],
    ).num_devices  # fmt: skip
    if found > 1 and settings.strategy == "single_device":
        raise ValueError(
            f"trainer.devices={settings.devices} asks for {found} devices, trainer.strategy=single_device for one: "
            "take trainer.strategy=ddp, or trainer.devices=1."
        )
    return found


def check_devices(settings: Settings, objective: Objective, data: GameData) -> int:
    """How many devices a training asks for.

    Raises:
        ValueError: there are none such, or more than a step has rows for.
    """
    count = device_count(settings)
    for name in sorted(data.streams):
        size = data.batch_sizes[name]
        rows = size if size is None or name != "interior" else objective.kept(size)
        if rows is not None and rows < count:
            raise ValueError(
                f"trainer.devices={settings.devices} asks for {count} devices, but a step has {rows} rows of "
                f"data.batch_sizes.{name}: take at least one row for each, or fewer devices."
            )
    return count


def make_trainer(
    settings: Settings,
    folder: Path,
    loggers: Sequence[Logger],
    callbacks: Sequence[L.Callback],
    ranks: Ranks = Ranks(),
) -> L.Trainer:
    """A trainer that runs for a number of steps and leaves `last.ckpt`, of what is validated every so often.

    Args:
        settings: how to train.
        folder: where checkpoints go.
        loggers: of Lightning.
        callbacks: of Lightning.
        ranks: the place of this process among those of the training; there are as many as devices.

    Raises:
        ValueError: there is no such accelerator, precision, profiler or argument.
    """
    check_arguments(settings.lightning)
    if settings.strategy not in STRATEGIES:
        raise ValueError(
            f"trainer.strategy must be {', '.join(STRATEGIES)}; got {settings.strategy!r}. Others part what is small."
        )
    every, files = settings.validate_every, CheckpointFiles()
    # After a validation, when the step is over and in the curves: what goes on from there lacks and repeats nothing.
    keeping_last = ModelCheckpoint(
        folder, Path(LAST).stem, every_n_epochs=1, save_on_train_epoch_end=False, enable_version_counter=False
    )
    free = {"log_every_n_steps": max(1, min(50, settings.planned)), "enable_model_summary": False, **settings.lightning}
    return L.Trainer(
        accelerator=settings.accelerator,
        strategy="auto" if ranks.count == 1 else Together(ranks),
        devices=settings.devices,
        precision=settings.precision,
        max_steps=settings.steps,
        max_epochs=-1,
        gradient_clip_val=settings.gradient_clip_val,
        val_check_interval=every,
        check_val_every_n_epoch=None,
        num_sanity_val_steps=0,
        logger=list(loggers) or False,
        callbacks=[StopOnDivergence(folder, files), *callbacks, keeping_last],
        plugins=[files, *([Here()] if ranks.count == 1 else [])],
        profiler=profiler(settings.profiler, folder),
        enable_progress_bar=any(isinstance(callback, ProgressBar) for callback in callbacks),
        default_root_dir=folder,
        inference_mode=False,
        use_distributed_sampler=False,
        **free,
    )
