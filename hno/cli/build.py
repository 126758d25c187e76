"""From the settings of a training to its objects."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from hno.cli.checkpoints import resumed
from hno.cli.config import read
from hno.cli.evaluate import check_evaluation, unseen_types
from hno.cli.settings import GameSettings, TrainSettings
from hno.data import Collocation, GameData, LabelPlan, make_sampler
from hno.data.curriculum import Curriculum
from hno.data.labels import Report, default_cache
from hno.evaluation.kernels import check_rows
from hno.games import Game, make
from hno.games.grid import parse_types
from hno.losses import Objective, make_objective
from hno.operators import Architecture, Choice, make_operator
from hno.training.fit import Settings
from hno.training.optimizers import make_optimizer


def check(config: DictConfig) -> TrainSettings:
    """The settings of a run that can be made; nothing is solved or written.

    Raises:
        ValueError, LookupError: entries that are unknown or make no sense, together or for the game.
    """
    settings = read(TrainSettings, config)
    with warnings.catch_warnings(action="ignore"):  # the run warns
        game = build_game(settings.game)
        check_evaluation(game, settings.evaluation)
        unseen_types(game, settings.evaluation.types, "evaluation.types")
        if settings.validation.types is not None:
            parse_types(game, settings.validation.types, key="validation.types")
        operator, objective = make_operator(game, build_architecture(settings)), build_objective(settings)
        build_data(settings, game, objective.streams(exact_terminal=operator.meets_terminal))
        make_optimizer(steps=settings.trainer.max_steps, **settings.optimizer)
        if settings.evaluation.ntk:
            check_rows(operator, settings.evaluation.ntk_rows)
    if settings.resume is not None:
        resumed(settings.resume)
    return settings


def build_game(settings: GameSettings) -> Game:
    """The chosen game with its changed constants."""
    return make(settings.name, **settings.constants)


def build_architecture(settings: TrainSettings) -> Architecture:
    """What the operator is built of."""
    operator = dict(settings.operator)
    operator["name"] = operator.pop("function")
    return Architecture(*map(_choice, (operator, settings.network, settings.activation)))


def _choice(content: dict[str, Any]) -> Choice:
    return Choice(content["name"], {key: value for key, value in content.items() if key != "name"})


def build_objective(settings: TrainSettings) -> Objective:
    """The method: loss terms and weights."""
    return make_objective(**settings.loss.model_dump())


def build_data(settings: TrainSettings, game: Game, needed: frozenset[str], report: Report | None = None) -> GameData:
    """The streams that the objective's terms read."""
    data, steps = settings.data, settings.trainer.max_steps
    finish = round((1 - data.finish) * steps) if data.finish else None
    curriculum = Curriculum(round(data.pretrain * steps), round(data.widening * steps), finish)
    none = data.types in (None, []) and data.files  # those of the files alone
    labels = LabelPlan(
        types=() if none else parse_types(game, data.types),
        trajectories=data.trajectories,
        validation=data.validation,
        files=[Path(file) for file in data.files],
        cache=Path(data.cache or default_cache()),
        workers=data.workers,
    )
    collocation = Collocation(make_sampler(settings.sampler), curriculum, data.interior_types)
    return GameData(game, needed, settings.seed, labels, collocation, data.batch_sizes.model_dump(), report)


def build_settings(settings: TrainSettings) -> Settings:
    """How to train."""
    trainer = settings.trainer
    return Settings(
        steps=trainer.max_steps,
        optimizer=settings.optimizer,
        validate_every=trainer.validate_every,
        stop_when_safe=settings.validation.stop_when_safe,
        dt=settings.evaluation.dt,
        accelerator=trainer.accelerator,
        devices=trainer.devices,
        precision=trainer.precision,
        gradient_clip_val=trainer.gradient_clip_val,
        polish=trainer.polish,
        compile=trainer.compile,
    )
