"""Training as a library call."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import lightning as L
from lightning.pytorch.loggers import Logger
from lightning.pytorch.loggers.logger import DummyLogger

from hno.data import GameData
from hno.data.certificates import safe_sets
from hno.data.folders import check_room
from hno.losses import Objective, Scales
from hno.operators import ValueOperator
from hno.processes import stop_if_asked, waiting_signals
from hno.training.adaptive import AdaptiveLabels, Round
from hno.training.checkpoint import check_training_state, same_run
from hno.training.interruption import SaveOnSignal
from hno.training.logbook import Logbook
from hno.training.module import TrainingModule
from hno.training.optimizers import make_optimizer
from hno.training.polish import Polish
from hno.training.quiet import quiet_lightning
from hno.training.ranks import Ranks
from hno.training.saving import BEST, LAST, UNFIT, CheckpointError, read_content, reason, remove_drafts
from hno.training.settings import LONG, Settings
from hno.training.together import together
from hno.training.trainer import check_devices, make_trainer
from hno.training.validation import ClosedLoopValidation, Later, Score
from hno.types import Extremal

log = logging.getLogger(__name__)

_LEARNED = {False: "the players' values", True: "a potential"}


class Fitted(NamedTuple):
    """What came of a training."""

    trainer: L.Trainer
    checkpoint: Path
    """The best checkpoint by closed-loop validation, or the last one where there was none."""
    metrics: dict[str, float]
    """Losses of the last step, and errors on held-out labels."""
    best: Score | None
    """Of closed-loop validation."""
    rounds: list[Round]
    """What was labelled while training."""
    seconds: dict[str, float]
    """Time spent on training, on validation without its labels, and on labels that were added, if any, s; by runs that
    this one goes on from too."""


@dataclass(frozen=True)
class _Training:
    """What every process of a training knows."""

    operator: ValueOperator
    objective: Objective
    data: GameData
    settings: Settings
    folder: Path
    validation: Sequence[Extremal]
    record: Mapping[str, Any] | None
    callbacks: Sequence[L.Callback]
    resume: Path | None
    best_too: bool
    """Whether the best checkpoint in the folder is of the run that goes on."""

    @quiet_lightning()
    def run(
        self,
        ranks: Ranks,
        loggers: Sequence[Logger],
        watching: Sequence[L.Callback] = (),
        later: Later | None = None,
    ) -> Fitted:
        """Train, as one of the processes."""
        settings, data, folder, plan = self.settings, self.data, self.folder, self.data.labels
        optimizer = make_optimizer(steps=settings.planned, **settings.optimizer)
        module = TrainingModule(self.operator, self.objective, optimizer, self.record, ranks)
        if settings.compile and settings.planned >= LONG:
            self.operator.compile_kernels()
        every, dt = settings.validate_every, settings.dt
        watch = ClosedLoopValidation(folder, every, dt=dt, stop=settings.stop_when_safe, ranks=ranks)
        watch.begin(self.validation, later)
        watch.resumes = self.best_too
        adding = AdaptiveLabels(settings.adaptive, settings.planned, data.seed, dt, plan.solver, plan.workers, ranks)
        logbook = Logbook()
        guard = SaveOnSignal(folder, lambda step: step in adding.due or watch.due(step, settings.steps), ranks)
        own = [guard, adding, watch, Polish(settings.polish, watch), logbook]
        trainer = make_trainer(settings, folder, loggers, [*own, *self.callbacks, *watching], ranks)
        try:
            trainer.fit(module, datamodule=data, ckpt_path=self.resume, weights_only=True)
        except UNFIT as error:
            if self.resume is None or module.began:
                raise
            raise CheckpointError(f"{self.resume} does not fit this run: {reason(error)}") from error
        added = sum(found.seconds for found in adding.done)
        training = logbook.seconds - watch.seconds - added
        seconds = {"training": training, "validation": watch.seconds - watch.solving}
        seconds |= {"added_labels": added} if adding.done else {}
        checkpoint = folder / (LAST if watch.best is None else BEST)  # a best one of another run does not count
        return Fitted(trainer, checkpoint, logbook.metrics, watch.best, adding.done, seconds)

    def follow(self, ranks: Ranks, logged: bool) -> None:
        """Train as one of the others: nothing is written, and callbacks have a logger where there is one elsewhere."""
        self.run(ranks, [DummyLogger()] if logged else [])


@quiet_lightning()
def fit(
    operator: ValueOperator,
    objective: Objective,
    data: GameData,
    settings: Settings,
    folder: Path,
    *,
    validation: Sequence[Extremal] | None = None,
    later: Later | None = None,
    record: Mapping[str, Any] | None = None,
    loggers: Sequence[Logger] = (),
    callbacks: Sequence[L.Callback] = (),
    watching: Sequence[L.Callback] = (),
    resume: Path | None = None,
) -> Fitted:
    """Train an operator; the folder gets `last.ckpt`, `previous.ckpt` and, with closed-loop validation, `best.ckpt`.

    Where there are several devices this process uses the first one and starts another process for each of the others.

    Args:
        operator: changed in place.
        objective: loss terms and weights.
        data: its streams are those of the objective.
        settings: how to train.
        folder: where checkpoints go.
        validation: labels of safe starts that closed-loop validation plays, one set per type; without any there is
            none. The safe starts of held-out labels by default.
        later: all starts, where `validation` are the first of each type only.
        record: entries of checkpoints besides the weights, see `hno.training.checkpoint.record`.
        loggers: of Lightning.
        callbacks: of Lightning, besides those that watch the run.
        watching: callbacks that look on, in this process alone.
        resume: a checkpoint of the same run to go on from.

    Raises:
        DivergedError: the loss, a gradient, a weight, or the error on held-out labels is no longer sound.
        CheckpointError: the training cannot go on from the checkpoint.
        RankError: the process of another device failed.
        OSError: the checkpoints do not fit into the folder.
    """
    if data.potential != operator.potential:
        raise ValueError(
            f"The operator learns {_LEARNED[operator.potential]}, the data label {_LEARNED[data.potential]}: make them "
            "alike with GameData(potential=operator.potential)."
        )
    count = check_devices(settings, objective, data)
    make_optimizer(steps=settings.planned, **settings.optimizer)
    settings.adaptive.steps(settings.planned)
    data.setup("fit")
    _learn_sizes(operator, objective, data)
    if validation is None:
        validation = safe_sets(data.held_out())
    remove_drafts(folder)
    if resume is not None:
        check_training_state(resume, read_content(resume), settings.steps)
    best_too = resume is None or same_run(folder / BEST, resume)
    _check_room(folder, operator)
    training = _Training(
        operator, objective, data, settings, folder, validation, record, callbacks, resume, best_too
    )  # fmt: skip
    theirs = replace(training, data=data.for_another_process(), settings=replace(settings, profiler=None))
    with waiting_signals(), together(count, partial(theirs.follow, logged=bool(loggers))) as ranks:
        fitted = training.run(ranks, loggers, watching, later)
    stop_if_asked()
    return fitted


def _learn_sizes(operator: ValueOperator, objective: Objective, data: GameData) -> None:
    """Tell an operator what it takes from the labels: sizes of values and costates, and which branches there are."""
    if objective.scaled:
        operator.set_scales(Scales(*data.scales()))
    if data.train_rows is not None and data.train_rows.types is not None and data.train_rows.types.branch is not None:
        operator.set_branches(data.train_rows.types.branch)


def _check_room(folder: Path, operator: ValueOperator) -> None:
    """Refuse a folder without room for the checkpoints: weights and two moments, and a draft beside those kept."""
    weights = sum(parameter.nbytes for parameter in operator.parameters())
    check_room(folder, 3 * 3 * weights, "Checkpoints", "choose another folder")
