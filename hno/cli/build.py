"""From configuration to objects."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from hno.cli.checks import flag, is_number, whole_number
from hno.cli.results import plain
from hno.data import Collocation, GameData, LabelPlan, make_sampler
from hno.data.curriculum import Curriculum
from hno.data.labels import Report, default_cache
from hno.games import Game, make
from hno.losses import Objective, make_objective
from hno.operators import Architecture, Choice
from hno.training.fit import Settings

SIZES = (
    "data.trajectories", "data.validation", "data.workers", "trainer.max_steps",
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
    for name in ("data.pretrain", "data.widening", "data.finish"):
        value = OmegaConf.select(config, name)
        if not (is_number(value) and 0 <= value <= 1):
            raise ValueError(f"{name} is a share of the run and must lie in [0, 1]; got {value!r}.")


def build_game(config: DictConfig) -> Game:
    """The chosen game with its changed constants."""
    return make(config.game.name, **plain(config.game.constants))


def build_architecture(config: DictConfig) -> Architecture:
    """What the operator is built of."""
    options = plain(config.operator)
    del options["name"]  # that of the method
    return Architecture(
        Choice(options.pop("function"), options), _choice(plain(config.network)), _choice(plain(config.activation))
    )


def _choice(content: dict[str, Any]) -> Choice:
    return Choice(content.pop("name"), content)


def build_objective(config: DictConfig) -> Objective:
    """The method: loss terms and weights; entries that are null are left out."""
    options = plain(config.loss)
    terms, weights = (_set(options.pop(name)) for name in ("terms", "weights"))
    return make_objective(terms, weights, **options)


def _set(content: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in content.items() if value is not None}


def build_data(config: DictConfig, game: Game, streams: frozenset[str], report: Report | None = None) -> GameData:
    """The streams that the objective's terms read."""
    data, steps = config.data, config.trainer.max_steps
    finish = round((1 - data.finish) * steps) if data.finish else None
    curriculum = Curriculum(round(data.pretrain * steps), round(data.widening * steps), finish)
    return GameData(
        game,
        streams,
        config.seed,
        LabelPlan(
            types=game.validate_types(data.types),
            trajectories=data.trajectories,
            validation=data.validation,
            files=[Path(file) for file in data.files],
            cache=cache_folder(data.cache),
            workers=data.workers,
        ),
        Collocation(make_sampler(plain(config.sampler)), curriculum, data.interior_types),
        plain(data.batch_sizes),
        report,
    )


def cache_folder(choice: str | None) -> Path:
    """The folder of label files."""
    return Path(choice) if choice is not None else default_cache()


def build_settings(config: DictConfig) -> Settings:
    """How to train."""
    trainer = config.trainer
    return Settings(
        steps=trainer.max_steps,
        optimizer=plain(config.optimizer),
        validate_every=trainer.validate_every,
        stop_when_safe=config.validation.stop_when_safe,
        dt=config.evaluation.dt,
        accelerator=trainer.accelerator,
        devices=trainer.devices,
        precision=trainer.precision,
        gradient_clip_val=trainer.gradient_clip_val,
        polish=trainer.polish,
        compile=trainer.compile,
    )
