"""Lightning's trainer: what of it may be chosen, and what a training of ours decides by itself."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning as L
from lightning.pytorch.callbacks import ModelCheckpoint, ProgressBar
from lightning.pytorch.loggers import Logger
from lightning.pytorch.profilers import AdvancedProfiler, Profiler, PyTorchProfiler, SimpleProfiler

from hno.registry import UnknownNameError, unknown_name
from hno.training.divergence import StopOnDivergence
from hno.training.saving import LAST, CheckpointFiles

if TYPE_CHECKING:
    from hno.training.fit import Settings

PROFILERS: Mapping[str, type[Profiler]] = {
    "simple": SimpleProfiler, "advanced": AdvancedProfiler, "pytorch": PyTorchProfiler,
}  # fmt: skip
"""Each writes a file, or files, named profile into the run's folder."""
STRATEGIES = ("auto", "single_device")
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


def make_trainer(
    settings: Settings, folder: Path, loggers: Sequence[Logger], callbacks: Sequence[L.Callback]
) -> L.Trainer:
    """A trainer that runs for a number of steps and leaves `last.ckpt`, of what is validated every so often.

    Raises:
        ValueError: there is no such accelerator, precision, profiler or argument, or there are several devices.
    """
    check_arguments(settings.lightning)
    if settings.strategy not in STRATEGIES:
        raise ValueError(
            f"trainer.strategy must be {' or '.join(STRATEGIES)}; got {settings.strategy!r}: a run trains on one "
            "device. Put several to use with one run on each."
        )
    every, files = settings.validate_every, CheckpointFiles()
    # After a validation, when the step is over and in the curves: what goes on from there lacks and repeats nothing.
    keeping_last = ModelCheckpoint(
        folder, Path(LAST).stem, every_n_epochs=1, save_on_train_epoch_end=False, enable_version_counter=False
    )
    free = {"log_every_n_steps": max(1, min(50, settings.planned)), "enable_model_summary": False, **settings.lightning}
    trainer = L.Trainer(
        accelerator=settings.accelerator,
        strategy=settings.strategy,
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
        plugins=[files],
        profiler=profiler(settings.profiler, folder),
        enable_progress_bar=any(isinstance(callback, ProgressBar) for callback in callbacks),
        default_root_dir=folder,
        inference_mode=False,
        **free,
    )
    if trainer.world_size > 1:
        raise ValueError(
            f"trainer.devices={settings.devices} asks for {trainer.world_size} devices; a run trains on one. Choose it "
            "with trainer.devices=1 or its number, [1], and put several devices to use with one run on each."
        )
    return trainer
