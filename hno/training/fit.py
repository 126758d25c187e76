"""Training as a library call."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import lightning as L
from lightning.pytorch.loggers import Logger

from hno.data import GameData
from hno.data.certificates import safe_sets
from hno.data.folders import check_room
from hno.losses import Objective, Scales
from hno.operators import ValueOperator
from hno.processes import stop_if_asked, waiting_signals
from hno.training.adaptive import Adaptive, AdaptiveLabels, Round
from hno.training.checkpoint import check_training_state, same_run
from hno.training.interruption import SaveOnSignal
from hno.training.logbook import Logbook
from hno.training.module import TrainingModule
from hno.training.optimizers import make_optimizer
from hno.training.polish import Polish
from hno.training.quiet import quiet_lightning
from hno.training.saving import BEST, LAST, UNFIT, CheckpointError, read_content, reason, remove_drafts
from hno.training.trainer import make_trainer
from hno.training.validation import ClosedLoopValidation, Later, Score
from hno.types import Extremal

log = logging.getLogger(__name__)

PRECISIONS = ("32-true", "32")
"""Precisions of Lightning in which a training is sound. The others move the game, its simulation and the scales to 16
or 64 bits, or compute residuals in 16; the step gains nothing by them, since derivatives are taken in 32 anyway."""
LONG = 20_000
"""Steps from which on compiling pays: it takes some ten seconds and saves about a millisecond a step."""


@dataclass(frozen=True)
class Settings:
    """How an operator is trained: a field for every choice, all with defaults."""

    steps: int = 2000
    schedule_steps: int | None = None
    """Steps over which the rate falls and labels are added; `steps` by default. Those beyond keep the final rate."""
    optimizer: Mapping[str, Any] = field(default_factory=lambda: {"name": "soap"})
    """Name and options, see `hno.training.optimizers.make_optimizer`."""
    validate_every: int = 500
    """Steps between validations and checkpoints."""
    stop_when_safe: bool = False
    """End the training as soon as no validation start collides."""
    dt: float = 0.02
    """Time for which validation episodes hold a control, s."""
    accelerator: str = "auto"
    devices: int | str | list[int] = 1
    """One device: 1, or its number in a list."""
    precision: Any = "32-true"
    """One of `PRECISIONS`."""
    gradient_clip_val: float | None = None
    strategy: str = "auto"
    """"auto" or "single_device"."""
    profiler: str | None = None
    """"simple", "advanced" or "pytorch"; it writes into the folder."""
    lightning: Mapping[str, Any] = field(default_factory=dict)
    """Further arguments of Lightning's trainer, see `hno.training.trainer.CONTROLLED` for those that are none."""
    polish: int = 0
    """Iterations of L-BFGS on all labelled rows after the last step."""
    adaptive: Adaptive = field(default_factory=Adaptive)
    """Labels that are added while training."""
    compile: bool = True
    """`torch.compile` in runs of at least `LONG` steps."""

    @property
    def planned(self) -> int:
        """Steps over which everything that changes with them is laid out."""
        return self.schedule_steps or self.steps

    def __post_init__(self) -> None:
        """Refuse, with a ValueError, a precision in which simulation and residuals would be wrong."""
        if str(self.precision) not in PRECISIONS:
            raise ValueError(
                f"trainer.precision must be {PRECISIONS[0]}; got {self.precision!r}. Others would compute residuals or "
                "move the game and its simulation in 16 or 64 bits."
            )


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
    resume: Path | None = None,
) -> Fitted:
    """Train an operator; the folder gets `last.ckpt`, `previous.ckpt` and, with closed-loop validation, `best.ckpt`.

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
        resume: a checkpoint of the same run to go on from.

    Raises:
        DivergedError: the loss, a gradient, a weight, or the error on held-out labels is no longer sound.
        CheckpointError: the training cannot go on from the checkpoint.
        OSError: the checkpoints do not fit into the folder.
    """
    if data.potential != operator.potential:
        raise ValueError(
            f"The operator learns {_LEARNED[operator.potential]}, the data label {_LEARNED[data.potential]}: make them "
            "alike with GameData(potential=operator.potential)."
        )
    optimizer = make_optimizer(steps=settings.planned, **settings.optimizer)
    module = TrainingModule(operator, objective, optimizer, record)
    if settings.compile and settings.planned >= LONG:
        operator.compile_kernels()
    data.setup("fit")
    _learn_sizes(operator, objective, data)
    watch = ClosedLoopValidation(folder, settings.validate_every, dt=settings.dt, stop=settings.stop_when_safe)
    watch.begin(safe_sets(data.held_out()) if validation is None else validation, later)
    plan = data.labels
    adding = AdaptiveLabels(settings.adaptive, settings.planned, data.seed, settings.dt, plan.solver, plan.workers)
    logbook = Logbook()
    guard = SaveOnSignal(folder, lambda step: step in adding.due or watch.due(step, settings.steps))
    own = [guard, adding, watch, Polish(settings.polish, watch), logbook]
    trainer = make_trainer(settings, folder, loggers, [*own, *callbacks])
    remove_drafts(folder)
    if resume is not None:
        check_training_state(resume, read_content(resume), settings.steps)
        watch.resumes = same_run(folder / BEST, resume)
    _check_room(folder, operator)
    try:
        with waiting_signals():
            trainer.fit(module, datamodule=data, ckpt_path=resume, weights_only=True)
    except UNFIT as error:
        if resume is None or module.began:
            raise
        raise CheckpointError(f"{resume} does not fit this run: {reason(error)}") from error
    stop_if_asked()
    added = sum(found.seconds for found in adding.done)
    training = logbook.seconds - watch.seconds - added
    seconds = {"training": training, "validation": watch.seconds - watch.solving}
    seconds |= {"added_labels": added} if adding.done else {}
    checkpoint = folder / (LAST if watch.best is None else BEST)  # a best one of another run does not count
    return Fitted(trainer, checkpoint, logbook.metrics, watch.best, adding.done, seconds)


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
