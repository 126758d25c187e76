"""From configuration to objects."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import lightning as L
from omegaconf import DictConfig, OmegaConf

from hno.cli.checks import flag, is_number, whole_number
from hno.cli.logs import StepLines, loggers, progress_bar
from hno.cli.results import plain
from hno.data import GameData
from hno.data.curriculum import Curriculum
from hno.data.labels import Report, default_cache
from hno.games import Game, make
from hno.losses import losses
from hno.operators import ValueOperator, operators
from hno.training.divergence import StopOnDivergence, checkpoints
from hno.training.optimizers import make_optimizer

SIZES = (
    "operator.width", "operator.depth", "data.trajectories", "data.validation", "data.workers", "trainer.max_steps",
    "trainer.validate_every", "trainer.print_every", "trainer.threads", "evaluation.starts",
)  # fmt: skip
"""Entries that must be whole and positive where they are set."""
FLAGS = (
    "operator.exact_terminal", "loss.scaled", "loss.balance", "trainer.compile", "validation.stop_when_safe",
    "evaluation.safe", "evaluation.ntk",
)  # fmt: skip
"""Entries that are true or false."""


def check_numbers(config: DictConfig) -> None:
    """Raise ValueError for sizes and rates that are not positive, and shares of the run outside [0, 1]."""
    for name in SIZES:
        value = OmegaConf.select(config, name)
        if value is not None:
            whole_number(name, value, 1)
    for name in ("optimizer.lr", "optimizer.final_lr"):
        value = OmegaConf.select(config, name)
        if not (is_number(value) and value > 0):
            raise ValueError(f"{name} must be a positive number; got {value!r}.")
    for name in FLAGS:
        value = OmegaConf.select(config, name)
        if value is not None:
            flag(name, value)
    whole_number("trainer.polish", config.trainer.polish, 0)
    whole_number("seed", config.seed, 0)
    for name, needed in (("data.types", not config.data.files), ("evaluation.types", False)):
        value = OmegaConf.select(config, name)
        if not OmegaConf.is_list(value) or (needed and not value):
            raise ValueError(f"{name} must list player types, such as [[1, 1], [5, 5]]; got {value!r}.")
    for name in ("data.pretrain", "data.widening", "data.finish"):
        value = OmegaConf.select(config, name)
        if not (is_number(value) and 0 <= value <= 1):
            raise ValueError(f"{name} is a share of the run and must lie in [0, 1]; got {value!r}.")


def build_game(config: DictConfig) -> Game:
    """The chosen game with its changed constants."""
    return make(config.game.name, **plain(config.game.constants))


def build_operator(config: DictConfig, game: Game) -> ValueOperator:
    """The chosen operator, ready to train."""
    options = plain(config.operator)
    cls = operators.get(options.pop("name"))
    if options.get("members") == 1 and options["members"] is not True:
        del options["members"]  # games may set it, and operators of your own need not know it
    optimizer = make_optimizer(steps=config.trainer.max_steps, **plain(config.optimizer))
    for term in config.loss.weights:
        losses.get(term)  # refuses a weight of a term that does not exist
    activation = plain(config.activation)
    return cls(
        game,
        activation=activation.pop("name"),
        activation_options=activation,
        weights=plain(config.loss.weights),
        norm=config.loss.norm,
        scaled=config.loss.scaled,
        balance=config.loss.balance,
        hardest=config.loss.hardest,
        optimizer=optimizer,
        **options,
    )


def build_data(config: DictConfig, operator: ValueOperator, report: Report | None = None) -> GameData:
    """The streams that the operator's terms read."""
    data, steps = config.data, config.trainer.max_steps
    return GameData(
        operator.game,
        streams=operator.streams,
        types=operator.game.validate_types(data.types),
        trajectories=data.trajectories,
        cache=cache_folder(data.cache),
        seed=config.seed,
        batch_sizes=plain(data.batch_sizes),
        curriculum=Curriculum(
            round(data.pretrain * steps),
            round(data.widening * steps),
            round((1 - data.finish) * steps) if data.finish else None,
        ),
        shares=plain(config.sampler),
        interior_types=data.interior_types,
        validation=data.validation,
        workers=data.workers,
        files=[Path(file) for file in data.files],
        report=report,
    )


def cache_folder(choice: str | None) -> Path:
    """The folder of label files."""
    return Path(choice) if choice is not None else default_cache()


def build_trainer(config: DictConfig, folder: Path, validation: L.Callback) -> L.Trainer:
    """A trainer that runs for a number of steps and leaves `last.ckpt` in the folder."""
    trainer = config.trainer
    callbacks: Sequence[L.Callback] = [
        StopOnDivergence(min(50, trainer.validate_every)),
        validation,
        checkpoints(folder, trainer.validate_every),
        progress_bar() or StepLines(trainer.print_every),
    ]
    return L.Trainer(
        accelerator=trainer.accelerator,
        devices=trainer.devices,
        precision=trainer.precision,
        max_steps=trainer.max_steps,
        max_epochs=-1,
        gradient_clip_val=trainer.gradient_clip_val,
        val_check_interval=min(trainer.validate_every, trainer.max_steps),
        check_val_every_n_epoch=None,
        num_sanity_val_steps=0,
        log_every_n_steps=max(1, min(50, trainer.max_steps)),
        logger=loggers(config, folder),
        callbacks=list(callbacks),
        enable_progress_bar=progress_bar() is not None,
        enable_model_summary=False,
        default_root_dir=folder,
        inference_mode=False,
    )
