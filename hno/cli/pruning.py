"""Ends a training that is worse than others of its study were at the same step."""

from __future__ import annotations

from pathlib import Path

import lightning as L
from optuna.study import Study
from optuna.trial import Trial, TrialState

from hno.cli.results import PrunedError
from hno.cli.search import Search
from hno.cli.study import opened
from hno.training.validation import ClosedLoopValidation

BEST = {"best/collision_rate": "collision_rate", "best/excess_cost": "excess"}
"""Objectives that are of the best checkpoint so far."""
WHILE = ("val/", "loss/", "closed_loop/")
"""How others begin that are known while a run trains."""


def known_while_training(name: str) -> bool:
    """Whether an objective has a value at every validation."""
    return name in BEST or name.startswith(WHILE)


class Pruning(L.Callback):
    """Tell the study of a trial its objective at every validation, and end the training where the pruner says so.

    Args:
        study: its trial is at work.
        number: of the trial.
        name: of its objective.
    """

    def __init__(self, study: Study, number: int, name: str) -> None:
        found = [one for one in study.get_trials(states=(TrialState.RUNNING,)) if one.number == number]
        if not found:
            raise RuntimeError(f"Trial {number} of the study {study.study_name} is not at work: nothing can be pruned.")
        self.trial, self.known, self.name = Trial(study, found[0]._trial_id), found[0].intermediate_values, name

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Report, and raise a `PrunedError` where the trial is hopeless."""
        if trainer.sanity_checking:
            return
        step, value = trainer.global_step, self.value(trainer)
        if step not in self.known:  # a job that is repeated comes by again
            self.trial.report(value, step)
        if self.trial.should_prune():
            raise PrunedError(f"stopped at step {step}, where {self.name} was {value:.4g}: other trials were better")

    def value(self, trainer: L.Trainer) -> float:
        """The objective now.

        Raises:
            ValueError: the run has no such number.
        """
        found = {name: float(value) for name, value in trainer.callback_metrics.items()}
        for watch in trainer.callbacks:  # type: ignore[attr-defined]  # lightning's own property
            if isinstance(watch, ClosedLoopValidation) and watch.best is not None:
                found |= {name: float(getattr(watch.best, field)) for name, field in BEST.items()}
        if self.name not in found:
            raise ValueError(
                f"objective: pruner= needs {self.name} at every validation; this run has {', '.join(sorted(found))}."
            )
        return found[self.name]


def pruning(search: Search, folder: Path, number: int, objective: str) -> list[L.Callback]:
    """The callback of a trial; none where nothing is to be pruned.

    Args:
        search: of the trial.
        folder: of the search.
        number: of the trial.
        objective: the only one.
    """
    return [Pruning(opened(search, folder), number, objective)] if search.pruner else []
