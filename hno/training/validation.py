"""Closed-loop validation while a model trains."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import lightning as L
import torch
from torch import Tensor

from hno.control.policy import Feedback
from hno.control.rollout import rollout
from hno.data import GameData
from hno.training.module import TrainingModule
from hno.training.ranks import Ranks
from hno.training.saving import BEST
from hno.types import Extremal, Trajectory, join, part

log = logging.getLogger(__name__)

PROBE = 8
"""Starts per type that are played first, by default."""
FEW = 4
"""All starts are played anyway where they are at most so many times the first ones."""


class Score(NamedTuple):
    """How good a policy is: safety first, then cost."""

    collision_rate: float
    """Collisions per start; starts that were not played because others collided count as collisions."""
    excess: float
    """Median of the joint cost above the equilibrium's, relative to the median of the equilibrium's."""

    def after(self, best: Score | None) -> Score | None:
        """The best score once this one came after `best`; None if it is worse. Costs within a per cent are chance."""
        if best is None or self.collision_rate < best.collision_rate:
            return self
        if not (self.collision_rate == best.collision_rate and self.excess <= best.excess + 0.01):
            return None
        return Score(self.collision_rate, min(self.excess, best.excess))


class Later(NamedTuple):
    """A number of validation starts whose labels, one set per type that has any, are solved when they are needed."""

    starts: int
    solve: Callable[[], Sequence[Extremal]]


class Starts(NamedTuple):
    """Where episodes begin (B, P, n), player types (B, P), and the joint cost of the equilibrium (B,)."""

    x0: Tensor
    theta: Tensor
    cost: Tensor

    def like(self, tensor: Tensor) -> Starts:
        """The same in the type and on the device of a tensor."""
        return Starts(*(column.to(tensor) for column in self))


def starts_of(labels: Sequence[Extremal]) -> Starts:
    """Starts of labels, float32."""
    whole = join(labels)
    return Starts(whole.x[:, 0].float(), whole.theta.float(), whole.cost.float())


def score(played: Trajectory, starts: Starts) -> Score:
    """How good episodes are."""
    excess = (played.cost - starts.cost).nan_to_num(torch.inf).median() / starts.cost.median().abs()
    return Score(float(played.collided.float().mean()), float(excess))


class ClosedLoopValidation(L.Callback):
    """Validate in closed loop every so often, keep the best checkpoint, and end the training once it is safe, if asked.

    It rests unless it is given starts. Where there are many, the first ones of every type are played first, and the
    others only if none of these collides.

    Args:
        folder: where `best.ckpt` goes.
        every: steps between validations.
        probe: starts per type that are played first.
        dt: time for which a control is held, s.
        stop: whether to end the training as soon as no start collides.
        ranks: the processes of the training; the first one plays and tells the others.
    """

    def __init__(
        self,
        folder: Path,
        every: int,
        probe: int = PROBE,
        dt: float = 0.02,
        stop: bool = False,
        ranks: Ranks = Ranks(),
    ) -> None:
        self.path, self.every, self.count, self.dt, self.stop = folder / BEST, every, probe, dt, stop
        self.ranks = ranks
        self.all: Starts | None = None
        self.later: Later | None = None
        self.best: Score | None = None
        self.found: Score | None = None
        self.resumes = True
        self.seconds = self.solving = 0.0

    @property
    def satisfied(self) -> bool:
        """Whether the training is to end because no start collided."""
        return self.stop and self.best is not None and self.best.collision_rate == 0

    def due(self, step: int, last: int) -> bool:
        """Whether a step is one after which there is a validation."""
        return step % self.every == 0 or step == last

    def begin(self, labels: Sequence[Extremal], later: Later | None = None) -> None:
        """Play from the starts of these labels, which are safe, one set per type; without any, play nothing.

        If there are `later` ones, these are the first of them, and the others are solved once none of these collides.
        """
        if not labels:
            log.info("No validation start has a safe equilibrium: there is no closed-loop validation.")
            return
        self.all, self.later = starts_of(labels), later
        self.probe = starts_of([part(found, slice(self.count)) for found in labels])

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """A run that had ended is not trained on."""
        trainer.should_stop |= self.satisfied

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Validate where it is time to."""
        assert isinstance(pl_module, TrainingModule)
        due = self.due(trainer.global_step, trainer.max_steps)
        self.found = self.consider(trainer, pl_module) if due else None
        trainer.should_stop |= self.satisfied

    def on_validation_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Log what was found, beside the errors on held-out labels."""
        if self.found is not None:
            pl_module.log_dict({f"closed_loop/{name}": value for name, value in self.found._asdict().items()})

    def consider(self, trainer: L.Trainer, module: TrainingModule) -> Score | None:
        """Play, if there are starts, and write `best.ckpt` if nothing was better so far."""
        if self.all is None:
            return None
        began, starts, data = time.perf_counter(), self.all, getattr(trainer, "datamodule", None)
        found, visits = self.ranks.told(lambda: (self.play(trainer, module, starts), getattr(data, "visits", [])))
        if isinstance(data, GameData):
            data.visits = visits
        if better := found.after(self.best):
            self.best = better
            trainer.save_checkpoint(self.path, weights_only=False)
        self.seconds += time.perf_counter() - began
        return found

    def play(self, trainer: L.Trainer, module: TrainingModule, starts: Starts) -> Score:
        """The score on the probe if that collides, otherwise on all starts; the data are told where the probe went."""
        policy, like = Feedback(module.operator, checked=False), module.operator.value_scale
        game, probe, starts = policy.game, self.probe.like(like), starts.like(like)
        played = rollout(game, policy, probe.x0, probe.theta, self.dt)
        data = getattr(trainer, "datamodule", None)
        if isinstance(data, GameData):
            data.visit(played, trainer.global_step)
        found, count = score(played, probe), len(starts.cost) if self.later is None else self.later.starts
        if found.collision_rate > 0 and count > FEW * len(probe.cost):
            hits = found.collision_rate * len(probe.cost)
            return found._replace(collision_rate=(hits + count - len(probe.cost)) / count)
        if self.later is not None:
            began = time.perf_counter()
            self.all, self.later = starts_of(self.later.solve()), None
            self.solving += time.perf_counter() - began
            starts = self.all.like(like)
        if len(starts.cost) == len(probe.cost):
            return found
        return score(rollout(game, policy, starts.x0, starts.theta, self.dt), starts)

    def on_validation_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start the clock for the errors on held-out labels."""
        self.seconds -= time.perf_counter()

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Stop it."""
        self.seconds += time.perf_counter()

    def state_dict(self) -> dict[str, Any]:
        """The best score so far, and how long it took, without and with labels."""
        best = None if self.best is None else list(self.best)
        return {"best": best, "seconds": self.seconds, "solving": self.solving}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from it, where the checkpoint that it belongs to is there and is to be used (`resumes`)."""
        self.seconds, self.solving = float(state_dict["seconds"]), float(state_dict["solving"])
        self.best = Score(*state_dict["best"]) if state_dict["best"] and self.resumes and self.path.exists() else None
