"""The processes of one training: each takes its share of every batch, and all know the same of the whole."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from lightning.pytorch.strategies import DDPStrategy
from torch import Tensor, distributed, nn
from torch.distributed.distributed_c10d import Store

from hno.processes import take_back_signals
from hno.types import Sample

PATIENCE = datetime.timedelta(days=7)
"""How long the others wait for one rank, which may be solving labels. One that dies is noticed without it."""
Known = TypeVar("Known")


@dataclass(frozen=True)
class Ranks:
    """This process among those of a training, one per device. Alone it has all rows and asks nobody.

    Args:
        number: of this process; number 0 is the one that writes, validates and adds labels.
        count: of all of them.
        meet: waits until all are there; called in each of them before they are one group.
    """

    number: int = 0
    count: int = 1
    meet: Callable[[], Store] | None = None

    def share(self, sample: Sample) -> Sample:
        """Every `count`-th row of a whole sample, from its own number on."""
        if self.count == 1:
            return sample
        return sample.rows(torch.arange(self.number, sample.size, self.count, device=sample.points.tau.device))

    def mean(self, means: Tensor, sizes: Tensor) -> Tensor:
        """Means over all ranks' entries, the same numbers on each.

        Args:
            means: over this rank's entries, (T,).
            sizes: how many entries that were, (T,).

        Returns:
            (T,). The sum over the ranks of their gradients is the gradient of the whole.
        """
        if self.count == 1:
            return means
        own = torch.where(sizes > 0, means, 0)  # the mean of nothing is NaN
        sums = torch.stack([own.detach() * sizes, sizes])
        distributed.all_reduce(sums)
        total, entries = sums
        own = own * (sizes / entries)
        return own + (total / entries - own.detach())

    def add_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Replace gradients by their sums over the ranks; a parameter that no rank has used keeps none."""
        if self.count == 1:
            return
        known = list(parameters)
        own = [torch.zeros_like(each) if each.grad is None else each.grad for each in known]
        used = own[0].new_tensor([each.grad is not None for each in known])
        sums = torch.cat([*(grad.flatten() for grad in own), used])
        distributed.all_reduce(sums)
        *grads, used = sums.split([*(each.numel() for each in known), len(known)])
        for parameter, grad, ranks in zip(known, grads, used.tolist(), strict=True):
            parameter.grad = grad.view_as(parameter).clone() if ranks else None  # BLAS rounds by how memory is aligned

    def check_alike(self, parameters: Iterable[nn.Parameter]) -> None:
        """Make sure that all ranks have the same weights, as they do where equal steps are taken on equal devices.

        Raises:
            RuntimeError: they have not.
        """
        if self.count == 1:
            return
        own = torch.cat([each.detach().flatten() for each in parameters])
        least, most = own.clone(), own.clone()
        distributed.all_reduce(least, distributed.ReduceOp.MIN)
        distributed.all_reduce(most, distributed.ReduceOp.MAX)
        if not torch.equal(least, most):
            raise RuntimeError(
                "The devices of this training no longer have the same weights: the optimizer rounds differently on "
                "them. Use devices of one kind, trainer.deterministic=true, or trainer.devices=1."
            )

    def told(self, work: Callable[[], Known]) -> Known:
        """What rank 0 finds, on every rank; the others do not work."""
        if self.count == 1:
            return work()
        found: list[Any] = [work() if self.number == 0 else None]
        distributed.broadcast_object_list(found)
        return found[0]

    def largest(self, number: int) -> int:
        """The largest of one small number of each rank."""
        if self.count == 1:
            return number
        found = torch.tensor(number, device="cuda" if distributed.get_backend() == "nccl" else "cpu")
        distributed.all_reduce(found, distributed.ReduceOp.MAX)
        return int(found)


class Here(LightningEnvironment):
    """One machine whose processes are there already, also on a cluster."""

    creates_processes_externally = True

    def __init__(self, number: int = 0) -> None:
        super().__init__()
        self.number = number

    def local_rank(self) -> int:
        """Which of its devices this process has."""
        return self.number

    def node_rank(self) -> int:
        """There is no other machine."""
        return 0


class Together(DDPStrategy):
    """Lightning's data-parallel strategy, in processes that `hno.training.together` starts.

    The module is not wrapped: it adds its gradients by itself, in one message. Weights and buffers are the same
    everywhere from the beginning, and stay so, since every rank takes the same step.
    """

    def __init__(self, ranks: Ranks) -> None:
        super().__init__(cluster_environment=Here(ranks.number))
        self.ranks = ranks

    def _configure_launcher(self) -> None:
        """Nothing is launched."""

    def configure_ddp(self) -> None:
        """Nothing is wrapped."""

    def setup_distributed(self) -> None:
        """Become one group with the others."""
        self.set_world_ranks()
        assert self.ranks.meet is not None
        distributed.init_process_group(
            self._get_process_group_backend(), store=self.ranks.meet(), rank=self.ranks.number,
            world_size=self.ranks.count, timeout=PATIENCE,
        )  # fmt: skip

    def barrier(self, *args: Any, **kwargs: Any) -> None:
        """Wait for all; what Lightning does at a signal would disturb what the ranks tell each other."""
        take_back_signals()
        super().barrier(*args, **kwargs)
