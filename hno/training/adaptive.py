"""Labels where the controller goes wrong, made while it trains (after Nakamura-Zimmerer, Gong and Kang 2021).

A round plays from many states, labels those at which the value that the operator promises differs most from what its
controller gets, and trains on. Collisions differ most.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import lightning as L
import torch
from torch import Tensor

from hno.control.disturbance import Disturbance
from hno.control.policy import Feedback
from hno.control.rollout import rollout
from hno.data import GameData
from hno.data.datamodule import mix
from hno.data.many import solve_many
from hno.games import Game
from hno.pontryagin.online import subgame
from hno.pontryagin.solve import Solver
from hno.training.module import TrainingModule
from hno.training.ranks import Ranks
from hno.types import Extremal, Sample, Status, best_of, part

log = logging.getLogger(__name__)

ROUND = 7
"""Tells the random numbers of rounds from those of batches."""


@dataclass(frozen=True)
class Adaptive:
    """When and how many labels are added while an operator trains."""

    rounds: int = 0
    """How often; 0 for never."""
    labels: int = 256
    """Start states that are labelled in each round."""
    candidates: int = 2048
    """States that are played from in each round: half anywhere in the PDE box, half along disturbed episodes."""
    types: int = 16
    """Player types that they have, drawn anew in each round from the type box."""
    begin: float = 0.4
    """Share of the steps after which the first round comes."""
    end: float = 0.8
    """Share of the steps after which the last one comes."""
    widen: float = 2.0
    """Width of the boxes from which disturbed episodes start, in units of the start box."""
    disturbance: Disturbance = Disturbance(noise=0.2, delay=1)
    """Of these episodes."""
    shares: tuple[float, ...] = (0.75, 0.5, 0.25)
    """Times to go at which they are left, as shares of the horizon."""

    def steps(self, total: int) -> list[int]:
        """Steps after which rounds come.

        Raises:
            ValueError: there are more rounds than steps for them.
        """
        last = max(1, self.rounds - 1)
        due = [round(total * (self.begin + (self.end - self.begin) * k / last)) for k in range(self.rounds)]
        if len(set(due)) < self.rounds or 0 in due:
            raise ValueError(
                f"{self.rounds} rounds of added labels do not fit into {total} steps: train longer, or lower "
                "data.adaptive.rounds."
            )
        return due


class Round(NamedTuple):
    """What one round found, and what it bought."""

    step: int
    """Training steps before it."""
    candidates: int
    """States that were played from."""
    collided: int
    """Episodes that collided."""
    labelled: int
    """Start states that were labelled."""
    unsolved: int
    """Those without an equilibrium."""
    inevitable: int
    """Those whose equilibrium collides; they are not trained on."""
    lost: float | None
    """Median over the labelled ones that are trained on of the cost above the equilibrium's, relative to it; None where
    there is none."""
    seconds: float


class Candidates(NamedTuple):
    """States with one time to go."""

    tau: float
    x: Tensor
    """(C, P, n)."""
    theta: Tensor
    """(C, P)."""


class AdaptiveLabels(L.Callback):
    """Adds labels to the data of a training, between its steps. It rests where nothing is trained on labels.

    Args:
        plan: when and how many.
        steps: length of the training.
        seed: of candidates.
        dt: time for which episodes hold a control, s.
        solver: settings of the label solver.
        workers: label processes.
        ranks: the processes of the training; the first one makes the labels for all.
    """

    def __init__(
        self,
        plan: Adaptive,
        steps: int,
        seed: int,
        dt: float,
        solver: Solver = Solver(),
        workers: int | None = None,
        ranks: Ranks = Ranks(),
    ) -> None:
        self.plan, self.seed, self.dt, self.solver, self.workers = plan, seed, dt, solver, workers
        self.ranks = ranks
        self.due, self.done = plan.steps(steps), list[Round]()

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """A round, where it is time for one."""
        assert isinstance(pl_module, TrainingModule)
        data = getattr(trainer, "datamodule", None)
        if trainer.global_step in self.due and isinstance(data, GameData):
            if data.labelled is None or "bvp" not in data.streams:
                log.info("no labels are added: no loss term reads them")
                return
            policy, step = Feedback(pl_module.operator, checked=False), trainer.global_step
            data.labelled.added = self.ranks.told(lambda: self._added(policy, data, step))

    def _added(self, policy: Feedback, data: GameData, step: int) -> list[tuple[int, Sample]]:
        """What is there to train on besides the first labels, after a round."""
        found = self.round(policy, data, step)
        log.info(
            "round %d: %d of %d episodes collide; %d starts labelled, of which %d inevitable and %d unsolved",
            len(self.done), found.collided, found.candidates, found.labelled, found.inevitable, found.unsolved,
        )  # fmt: skip
        assert data.labelled is not None
        return data.labelled.added

    def round(self, policy: Feedback, data: GameData, step: int) -> Round:
        """Play, choose, label, and extend the data."""
        began, generator = time.perf_counter(), torch.Generator().manual_seed(mix(step, self.seed, ROUND))
        groups = list(candidates(data.game, policy, self.plan, self.dt, generator))
        played = [judged(policy, group, self.dt) for group in groups]
        gaps, before, found, costs = torch.cat([gap for gap, *_ in played]), 0, list[Extremal](), list[Tensor]()
        worst = gaps.topk(min(self.plan.labels, len(gaps))).indices
        chosen = torch.zeros_like(gaps, dtype=torch.bool).index_fill(0, worst, True)
        for group, (_, cost, _) in zip(groups, played, strict=True):
            rows = chosen[before : before + len(group.x)].nonzero().squeeze(-1)
            before += len(group.x)
            if len(rows):
                found.append(self._solved(data, group, rows))
                costs.append(cost[rows])
        best = [best_of(each) for each in found]
        safe = [sound(each) for each in best]
        assert data.labelled is not None
        data.labelled.extend(step, [part(each, sound(each)) for each in found])
        lost = torch.cat([(cost / b.cost - 1)[s] for cost, b, s in zip(costs, best, safe, strict=True)])
        unsolved = sum(int((each.status != Status.CONVERGED).sum()) for each in best)
        labelled = sum(len(each.status) for each in best)
        result = Round(
            step=step,
            candidates=len(chosen),
            collided=sum(int(hit.sum()) for *_, hit in played),
            labelled=labelled,
            unsolved=unsolved,
            inevitable=labelled - unsolved - sum(int(s.sum()) for s in safe),
            lost=float(lost.median()) if len(lost) else None,
            seconds=time.perf_counter() - began,
        )
        self.done.append(result)
        return result

    def _solved(self, data: GameData, group: Candidates, rows: Tensor) -> Extremal:
        game, x0, theta = subgame(data.game, group.tau), group.x[rows], group.theta[rows]
        return solve_many(game, x0, theta, self.solver, self.workers, all_equilibria=data.potential)

    def state_dict(self) -> dict[str, Any]:
        """Rounds so far."""
        return {"done": [list(found) for found in self.done]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on after them."""
        self.done = [Round(*found) for found in state_dict["done"]]


def candidates(
    game: Game, policy: Feedback, plan: Adaptive, dt: float, generator: torch.Generator
) -> Iterator[Candidates]:
    """States to play from: anywhere that is safe in the PDE box, and along disturbed episodes of the policy."""
    table = game.type_box.sample(plan.types, generator)
    half = plan.candidates // 2

    def types(size: int) -> Tensor:
        return table[torch.randint(len(table), (size,), generator=generator)]

    x, theta = game.state_box.sample(half, generator), types(half)
    keep = ~game.violates(x, theta)
    yield Candidates(game.horizon, x[keep], theta[keep])
    x, theta = game.initial_box.widened(plan.widen).sample(half, generator), types(half)
    keep = ~game.violates(x, theta)
    seed = int(torch.randint(2**31, (), generator=generator))
    like = policy.operator.value_scale
    disturbed = plan.disturbance._replace(seed=seed)
    path = rollout(policy.game, policy, x[keep].to(like), theta[keep].to(like), dt, disturbance=disturbed)
    for number, share in enumerate(plan.shares):
        left = max(1, round(share * game.horizon / dt))
        tau, node = left * dt, round(game.horizon / dt) - left
        now, theirs = path.x[number :: len(plan.shares), node].cpu().float(), theta[keep][number :: len(plan.shares)]
        usable = now.isfinite().flatten(1).all(-1) & ~game.violates(now, theirs)
        yield Candidates(tau, now[usable], theirs[usable])


def judged(policy: Feedback, group: Candidates, dt: float) -> tuple[Tensor, Tensor, Tensor]:
    """By how much the players' values differ from what they get, relative to it; what it costs; whether they collide.

    Returns:
        Three columns (C,), on the CPU.
    """
    operator, like = policy.operator, policy.operator.value_scale
    x, theta = group.x.to(like), group.theta.to(like)
    game = subgame(operator.game, group.tau).to(like)
    with torch.no_grad():
        promised = -policy.value(torch.full_like(theta[:, 0], group.tau), x, theta).sum(-1)
        played = rollout(game, policy, x, theta, dt)
    gap = (played.cost - promised).abs() / (like + promised.abs())
    return gap.nan_to_num(torch.inf, torch.inf).cpu(), played.cost.cpu(), played.collided.cpu()


def sound(found: Extremal) -> Tensor:
    """Which labels are trained on: those that converged and do not collide, (B,)."""
    return (found.status == Status.CONVERGED) & (found.clearance > 0)
