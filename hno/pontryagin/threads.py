"""How many threads torch uses for small work, and the processes that solve labels."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import joblib
import torch

from hno.processes import serve


def cores() -> int:
    """Cores that this job may use, which may be fewer than the machine has.

    The fewest that its CPU affinity, its cgroup, Slurm's `--cpus-per-task` and $LOKY_MAX_CPU_COUNT say.
    """
    return min(joblib.cpu_count(), int(os.environ.get("SLURM_CPUS_PER_TASK") or os.cpu_count() or 1))


def label_pool(count: int, return_as: Literal["list", "generator_unordered"] = "list") -> joblib.Parallel:
    """A pool of processes with one thread each, which end with this one, however that ends."""
    return joblib.Parallel(
        n_jobs=count, return_as=return_as, inner_max_num_threads=1, backend="loky",
        initializer=serve, initargs=(os.getpid(),),
    )  # fmt: skip


@contextmanager
def torch_threads(count: int = 1) -> Iterator[None]:
    """Run a block with so many threads of torch, then with as many as before.

    One is the default of `solve` and `rollout`: their tensors are so small that more threads only wait for each other.
    128 starts of the narrow road take 6 s with one thread and 130 s with two, on two cores that are busy.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
