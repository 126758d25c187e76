"""Closed-loop validation while a model trains."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import lightning as L
import torch
from torch import Tensor

from hno.evaluation.rollout import Policy, rollout
from hno.games import Game
from hno.operators import ValueOperator
from hno.operators.checkpoint import OperatorPolicy
from hno.types import Extremal, part

BEST = "best.ckpt"
"""Name of the best checkpoint inside a run's folder."""


class Score(NamedTuple):
    """How good a policy is; the smaller tuple is better: safety first, then cost."""

    collision_rate: float
    """Collisions per start."""
    excess: float
    """Median of the joint cost above the equilibrium's, relative to the median of the equilibrium's."""


class Starts(NamedTuple):
    """Where validation episodes begin, and what their equilibria cost."""

    x0: Tensor
    """(B, P, n)."""
    theta: Tensor
    """(B, P)."""
    cost: Tensor
    """Joint cost of the equilibrium, (B,)."""


def starts_of(labels: Sequence[Extremal]) -> Starts:
    """Starts of labels, float32."""
    x0, theta = (torch.cat(column).float() for column in zip(*((e.x[:, 0], e.theta) for e in labels), strict=True))
    return Starts(x0, theta, torch.cat([-found.value[:, 0].sum(-1) for found in labels]).float())


def score(game: Game, policy: Policy, starts: Starts, dt: float) -> Score:
    """Play every start; a collision is whatever keeps no positive clearance, NaN too."""
    played = rollout(game, policy, starts.x0, starts.theta, dt)
    excess = -played.value.sum(-1) - starts.cost
    rate = (~(played.clearance > 0)).float().mean()
    return Score(float(rate), float(excess.nan_to_num(torch.inf).median() / starts.cost.median().abs()))


class ClosedLoopValidation(L.Callback):
    """Validate in closed loop every so often, keep the best checkpoint, and end the training once it is safe, if asked.

    The first starts of every type are played first; only if none of them collides are all played.

    Args:
        labels: labels of safe starts, one set per type.
        folder: where `best.ckpt` goes.
        every: steps between validations.
        probe: starts per type that are played first.
        dt: time for which a control is held, s.
        stop: whether to end the training as soon as no start collides.
    """

    def __init__(
        self, labels: Sequence[Extremal], folder: Path, every: int, probe: int = 8, dt: float = 0.02, stop: bool = False
    ) -> None:
        self.all = starts_of(labels)
        self.probe = starts_of([part(found, slice(probe)) for found in labels])
        self.path, self.every, self.dt, self.stop = folder / BEST, every, dt, stop
        self.best: Score | None = None
        self.seconds = 0.0

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Validate where it is time to."""
        assert isinstance(pl_module, ValueOperator)
        step = trainer.global_step
        if step % self.every and step != trainer.max_steps:
            return
        began = time.perf_counter()
        found = self.score(pl_module)
        pl_module.log_dict({"closed_loop/collision_rate": found.collision_rate, "closed_loop/excess": found.excess})
        if self.best is None or found <= self.best:
            self.best = found
            trainer.save_checkpoint(self.path, weights_only=False)
        self.seconds += time.perf_counter() - began
        if self.stop and found.collision_rate == 0:
            trainer.should_stop = True

    def score(self, operator: ValueOperator) -> Score:
        """Of the probe if it collides, otherwise of all starts."""
        policy = OperatorPolicy(operator)
        found = score(operator.game, policy, self.probe, self.dt)
        return found if found.collision_rate > 0 else score(operator.game, policy, self.all, self.dt)

    def on_validation_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start the clock for the errors on held-out labels."""
        self.seconds -= time.perf_counter()

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Stop it."""
        self.seconds += time.perf_counter()

    def state_dict(self) -> dict[str, Any]:
        """The best score so far."""
        return {"best": None if self.best is None else list(self.best)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from it."""
        self.best = None if state_dict["best"] is None else Score(*state_dict["best"])
