"""From the settings of a training to its objects."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import NamedTuple

from lightning.fabric.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig

from hno.cli.config import read
from hno.cli.evaluate import check_evaluation, unseen_types
from hno.cli.logs import check_wandb
from hno.cli.settings import TrainSettings
from hno.data import Collocation, GameData, LabelPlan, make_sampler
from hno.data.curriculum import Curriculum
from hno.data.labels import Report, default_cache
from hno.evaluation.ntk import check_rows
from hno.games import Game, make
from hno.games.grid import parse_types
from hno.losses import Objective, make_objective
from hno.operators import Architecture, Choice, ValueOperator, make_operator
from hno.training.adaptive import Adaptive
from hno.training.checkpoint import find_checkpoint
from hno.training.fit import Settings, make_trainer
from hno.training.optimizers import make_optimizer
from hno.training.quiet import quiet_lightning
from hno.training.saving import RESUMED


class Built(NamedTuple):
    """The objects of a training."""

    architecture: Architecture
    operator: ValueOperator
    objective: Objective
    data: GameData


def check(config: DictConfig) -> TrainSettings:
    """The settings of a run that can be made; nothing is solved or written.

    Raises:
        ValueError, LookupError: entries that are unknown or make no sense, together or for the game.
    """
    settings = read(TrainSettings, config)
    if "wandb" in settings.logger.names:
        check_wandb()
    with warnings.catch_warnings(action="ignore"):  # the run warns
        built = build(settings)
        game = built.data.game
        check_evaluation(game, settings.evaluation)
        unseen_types(game, settings.evaluation.types, "evaluation.types")
        if settings.validation.types is not None:
            parse_types(game, settings.validation.types, key="validation.types")
        how_to_train(settings)
        make_optimizer(steps=settings.trainer.max_steps, **settings.optimizer)
        _check_device(settings)
        if settings.evaluation.ntk:
            check_rows(built.operator, settings.evaluation.ntk_rows)
    if settings.resume is not None:
        find_checkpoint(settings.resume, RESUMED)
    return settings


def _check_device(settings: TrainSettings) -> None:
    try:
        with quiet_lightning():
            make_trainer(how_to_train(settings), Path(), [], [], validates=False)
    except (MisconfigurationException, TypeError, ImportError) as error:
        raise ValueError(f"trainer.accelerator, trainer.devices or trainer.precision: {error}") from error


def build(settings: TrainSettings, report: Report | None = None) -> Built:
    """The chosen game, operator, method and data; labels are not solved yet.

    Args:
        settings: of the training.
        report: is told how many labels are solved.
    """
    game = make(settings.game.name, **settings.game.constants)
    parts = [dict(part) for part in (settings.function, settings.network, settings.activation)]
    architecture = Architecture(*(Choice(part.pop("name"), part) for part in parts))
    operator, objective = make_operator(game, architecture), make_objective(**settings.loss.model_dump())
    needed = objective.streams(exact_terminal=operator.meets_terminal)
    plans = _labels(settings, game), _collocation(settings)
    sizes = settings.data.batch_sizes.model_dump()
    data = GameData(game, needed, settings.seed, *plans, sizes, report, operator.potential)
    return Built(architecture, operator, objective, data)


def _labels(settings: TrainSettings, game: Game) -> LabelPlan:
    data = settings.data
    none = data.types in (None, []) and data.files  # those of the files alone
    return LabelPlan(
        types=() if none else parse_types(game, data.types),
        trajectories=data.trajectories,
        validation=data.validation,
        widen=data.widen,
        files=[Path(file) for file in data.files],
        cache=Path(data.cache or default_cache()),
        workers=data.workers,
    )


def _collocation(settings: TrainSettings) -> Collocation:
    data, steps = settings.data, settings.trainer.max_steps
    finish = round((1 - data.finish) * steps) if data.finish else None
    curriculum = Curriculum(round(data.pretrain * steps), round(data.widening * steps), finish)
    return Collocation(make_sampler(settings.sampler), curriculum, data.interior_types)


def how_to_train(settings: TrainSettings) -> Settings:
    """How to train; entries of `trainer` have the names of the fields."""
    shared = {name: value for name, value in settings.trainer if name in Settings.__dataclass_fields__}
    return Settings(
        steps=settings.trainer.max_steps,
        optimizer=settings.optimizer,
        stop_when_safe=settings.validation.stop_when_safe,
        dt=settings.evaluation.dt,
        adaptive=Adaptive(**settings.data.adaptive.model_dump()),
        **shared,
    )
