"""A process that asks for labels, with a solver that takes a while and writes down what it solves."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hno.data import labels, shards
from hno.games import Game, make
from hno.types import Extremal
from tests.fakes import fake_solve

SHARD = 4
REQUEST = labels.Request((1.0, 5.0), 26, 0, "train")


def ask(cache: Path, seconds: float, ready: Path | None = None) -> None:
    """Ask for the set in shards of four; every row that is solved is a line of `<cache>.log`.

    Args:
        cache: of labels.
        seconds: that the solver takes for a shard.
        ready: a folder in which this process says that it is ready, and waits for a file "go".
    """
    torch.set_num_threads(1)
    labels.SHARD = shards.SHARD = SHARD

    def solve(game: Game, x0: Tensor, theta: Tensor, *settings: Any, **options: Any) -> Extremal:
        with Path(f"{cache}.log").open("a") as log:
            log.writelines(f"{os.getpid()} {start.numpy().tobytes().hex()}\n" for start in x0)
        time.sleep(seconds)
        return fake_solve(game, x0, theta)

    labels.solve = solve
    if ready is not None:
        (ready / str(os.getpid())).touch()
        while not (ready / "go").exists():
            time.sleep(0.01)
    labels.labels_for(make("narrow_road"), [REQUEST], cache, workers=1)


if __name__ == "__main__":
    ask(Path(sys.argv[1]), float(sys.argv[2]))
