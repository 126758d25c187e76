"""What a network is: a scalar function of scaled inputs and of a branch input, with its gradient."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from hno.registry import Registry

networks: Registry[Network] = Registry("network", "hno.operators", base="hno.operators.network:Network")


class Inputs(NamedTuple):
    """Sizes of what a network is fed with.

    A row of y holds what a player sees of itself, a block of equal layout for every other player, and its role where
    roles differ. Players who are interchangeable have interchangeable blocks: a network for more than two players must
    not depend on their order.
    """

    ego: int
    """Scaled time to go and the player's own scaled state."""
    other: int
    """The scaled state of another player and, where there are several, its role and its scaled type."""
    others: int
    """Number of other players, P - 1."""
    role: int
    """1 where roles differ, otherwise 0."""
    sensors: int
    """Branch input."""

    @property
    def total(self) -> int:
        """Size of y."""
        return self.ego + self.others * self.other + self.role


class Network(nn.Module, abc.ABC):
    """N(y, a): one number for each row of scaled inputs y and each branch input a.

    A registered network is built as `cls(inputs, activation, **options)` with `Inputs` and the registered name and
    options of an activation bound into `activation()`, which makes a new one at every call.
    """

    @abc.abstractmethod
    def forward(self, y: Tensor, sensors: Tensor, which: Tensor) -> Tensor:
        """Value at each row, differentiable in everything.

        Args:
            y: scaled inputs, (R, `Inputs.total`).
            sensors: distinct branch inputs, (C, S): what depends on them alone is computed once for each.
            which: the branch input of each row, (R,).

        Returns:
            Shape (R,).
        """

    def values(self, y: Tensor, sensors: Tensor, which: Tensor) -> Tensor:
        """Values at each row for several branch inputs, `which` (R, M) -> (R, M), differentiable in everything.

        A network that shares work between them overrides it. Other arguments as in `forward`.
        """
        columns = which.shape[-1]
        return self(y.repeat_interleave(columns, 0), sensors, which.flatten()).view_as(which)

    def value_gradient(self, y: Tensor, sensors: Tensor, which: Tensor) -> tuple[Tensor, Tensor]:
        """Value at each row and its gradient in y, (R,) and (R, `Inputs.total`), differentiable in the parameters.

        By autograd; a network that knows a faster way overrides it. Arguments as in `forward`.
        """
        training = torch.is_grad_enabled() and any(weight.requires_grad for weight in self.parameters())
        with torch.inference_mode(False), torch.enable_grad():
            point = y.detach().clone().requires_grad_()
            value = self(point, sensors.clone(), which.clone())
            (gradient,) = torch.autograd.grad(value.sum(), point, create_graph=training)
        return (value, gradient) if training else (value.detach(), gradient)

    def compile_kernels(self) -> None:
        """Train through `torch.compile`, where the network knows how; it pays in long runs."""


MOST = 99
"""Members that an ensemble may have: more are a slip of the pen, or a file that is to fill the memory."""


class Ensemble(nn.ModuleList):
    """Networks trained on the same batches from different weights; what counts is their median, entry by entry.

    Where two equilibria cost nearly the same, each network rounds off the ridge between them in its own way; the median
    follows the majority.

    Args:
        build: makes one network.
        members: how many, an odd number.

    Raises:
        ValueError: `members` is no odd whole number, or above `MOST`.
    """

    def __init__(self, build: Callable[[], Network], members: int) -> None:
        if not (type(members) is int and 0 < members <= MOST and members % 2):
            raise ValueError(
                "function.members must be an odd whole number, such as 1 or 3, so that there is a median, and at most "
                f"{MOST}; got {members!r}."
            )
        super().__init__(build() for _ in range(members))

    @property
    def networks(self) -> list[Network]:
        """The members."""
        return [network for network in self if isinstance(network, Network)]

    def compile_kernels(self) -> None:
        """Train through `torch.compile`, where the networks know how."""
        for network in self.networks:
            network.compile_kernels()


def median(parts: Sequence[Tensor]) -> Tensor:
    """The median of an odd number of tensors, entry by entry."""
    return parts[0] if len(parts) == 1 else torch.stack(list(parts)).median(0).values
