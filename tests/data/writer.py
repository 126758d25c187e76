"""Label generation as a process that tests kill: a solver that answers at once, in shards of four rows."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from hno.data import labels, shards
from hno.games import Game, make
from hno.pontryagin.solve import Solver
from tests.fakes import fake_solve

SHARD = 4
THETAS = ((1.0, 1.0), (2.0, 3.0), (5.0, 5.0))


def write(cache: Path, starts: int, workers: int = 1) -> None:
    """Generate sets of three types."""
    torch.set_num_threads(1)
    labels.solve, labels._solve_alone = fake_solve, _solve_alone
    labels.SHARD = shards.SHARD = SHARD
    requests = [labels.Request(theta, starts, 0, "train") for theta in THETAS]
    labels.labels_for(make("narrow_road"), requests, cache, workers=workers)


def _solve_alone(number: int, game: Game, job: labels._Job, settings: Solver) -> tuple[int, Tensor | None]:
    """What worker processes run; they import the package anew."""
    labels.solve = fake_solve
    return number, labels._solve_shard(game, job, settings)
