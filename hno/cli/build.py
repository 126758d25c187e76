"""From the settings of a training to its objects."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any, NamedTuple

from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import Callback
from omegaconf import DictConfig

from hno.cli.config import read
from hno.cli.evaluate import check_evaluation, unseen_types
from hno.cli.logs import check_wandb
from hno.cli.resume import check_same_training, newest, own_configuration, run_folder, training_hash
from hno.cli.settings import TrainSettings
from hno.data import Collocation, GameData, LabelPlan, make_sampler
from hno.data.curriculum import Curriculum
from hno.data.exchange import drawn_by
from hno.data.labels import Report, default_cache
from hno.evaluation.ntk import check_rows
from hno.games import Game, make
from hno.games.grid import parse_types
from hno.losses import Objective, make_objective
from hno.operators import Architecture, Choice, ValueOperator, make_operator
from hno.training.adaptive import Adaptive
from hno.training.callbacks import callbacks
from hno.training.checkpoint import Draw, Provenance, check_resumable, record
from hno.training.optimizers import make_optimizer
from hno.training.quiet import quiet_lightning
from hno.training.ranks import Ranks
from hno.training.settings import Settings
from hno.training.trainer import check_devices, make_trainer


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
    settings = read(TrainSettings, own_configuration(config))
    if settings.resume is not None:
        check_same_training(settings)
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
        make_optimizer(steps=1, **settings.optimizer)
        _check_devices(settings, built)
        if settings.evaluation.ntk:
            check_rows(built.operator, settings.evaluation.ntk_rows)
    if settings.resume is not None and (path := newest(run_folder(settings.resume))):
        check_resumable(path, record_of(settings, built), settings.trainer.max_steps)
    return settings


def _check_devices(settings: TrainSettings, built: Built) -> None:
    try:
        with quiet_lightning():
            chosen = how_to_train(settings)
            count = check_devices(chosen, built.objective, built.data)
            make_trainer(chosen, Path(), [], chosen_callbacks(settings), Ranks(count=count))
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
    plans = _labels(settings, game), _collocation(settings, supervised="bvp" in needed)
    sizes = settings.data.batch_sizes.model_dump()
    data = GameData(game, needed, settings.seed, *plans, sizes, report, operator.potential)
    return Built(architecture, operator, objective, data)


def record_of(settings: TrainSettings, built: Built) -> dict[str, Any]:
    """What its checkpoints say of a training."""
    made_by = settings.seed, training_hash(settings), draws(settings, built.data)
    return record(
        built.data.game, built.architecture, Provenance(settings.operator.name, built.data.type_list, *made_by)
    )


def draws(settings: TrainSettings, data: GameData) -> list[Draw]:
    """Every draw of random states that a training reads, validates on or is stopped by."""
    choice, labelled = settings.validation, data.needs_labels
    found: list[Draw] = [("batches", "batches", data.seed)]
    if labelled:
        found += [("labels and held-out labels", "train", data.seed)]
        found += [(f"labels of {path.name}", *drawn_by(path)) for path in data.labels.files]
    if settings.data.adaptive.rounds:
        found += [("added labels", "adaptive", data.seed)]
    if choice.types is not None:
        found += [("validation and stopping", "validation", choice.seed)]
    elif labelled:
        found += [("validation and stopping", "train", data.seed)]
    return found


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


def _collocation(settings: TrainSettings, *, supervised: bool) -> Collocation:
    data, steps = settings.data, how_to_train(settings).planned
    longer = supervised and settings.trainer.max_steps > steps  # what follows the plan is supervised
    end = round((1 - data.finish) * steps) if data.finish or longer else None
    curriculum = Curriculum(round(data.pretrain * steps), round(data.widening * steps), end)
    return Collocation(make_sampler(settings.sampler), curriculum, data.interior_types)


def chosen_callbacks(settings: TrainSettings) -> list[Callback]:
    """The callbacks that the configuration chooses, by registered names."""
    return [callbacks.get(name)(**options) for name, options in settings.callbacks.items()]


def how_to_train(settings: TrainSettings) -> Settings:
    """How to train; entries of `trainer` have the names of the fields."""
    shared = settings.trainer.model_dump(include=set(Settings.__dataclass_fields__) - {"lightning"})
    return Settings(
        steps=settings.trainer.max_steps,
        optimizer=settings.optimizer,
        stop_when_safe=settings.validation.stop_when_safe,
        dt=settings.validation.dt,
        adaptive=Adaptive(**settings.data.adaptive.model_dump()),
        lightning=settings.trainer.lightning,
        **shared,
    )
