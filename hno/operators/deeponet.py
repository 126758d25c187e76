"""A DeepONet in dimensionless units (paper, eq. 7)."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import cast

import torch
from torch import Tensor, nn

from hno.operators.activations import Activation, activations
from hno.operators.value_gradient import Kernels, Layer, value_gradient


class MLP(nn.Module):
    """Fully connected net with one activation object, hence one trainable slope.

    Args:
        sizes: input, hidden and output widths.
        activation: of all hidden layers.
    """

    def __init__(self, sizes: tuple[int, ...], activation: Activation) -> None:
        super().__init__()
        self.activation = activation
        layers = [nn.Linear(a, b) for a, b in itertools.pairwise(sizes)]
        for index, layer in enumerate(layers):
            self.activation.init_(layer, first=index == 0)
        self.layers = nn.ModuleList(layers)

    def forward(self, z: Tensor) -> Tensor:
        """(..., inputs) -> (..., outputs), the last layer linear."""
        for layer in self.layers[:-1]:
            z = self.activation(layer(z))
        return self.layers[-1](z)

    def folded(self) -> tuple[list[Layer], Layer]:
        """Hidden layers whose activation is its core alone, and the last layer, differentiable in the parameters.

        What the activation does to its argument goes into the weights before it, what it does to its result into those
        after it.
        """
        activation, folded = self.activation, list[Layer]()
        for index, layer in enumerate(self.layers):
            assert isinstance(layer, nn.Linear)
            weight, bias = layer.weight, layer.bias
            if index == 0:
                folded.append(Layer(weight, bias))
            else:
                folded.append(Layer(activation.gain * weight, bias + activation.shift * weight.sum(-1)))
        hidden = [Layer(activation.factor * weight, activation.factor * bias) for weight, bias in folded[:-1]]
        return hidden, folded[-1]


class DeepONet(nn.Module):
    """sum_k branch_k(a) trunk_k(y).

    Args:
        trunk_inputs: size of y, scaled time and states.
        sensors: size of the branch input a.
        activation: registered name, for both nets.
        width: hidden and output width.
        depth: hidden layers.
        options: arguments of the activation.
    """

    def __init__(
        self,
        trunk_inputs: int,
        sensors: int,
        activation: str,
        width: int = 64,
        depth: int = 4,
        options: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        super().__init__()
        hidden, make = (width,) * (depth + 1), activations.get(activation)
        self.trunk = MLP((trunk_inputs, *hidden), make(**options))
        self.branch = MLP((sensors, *hidden), make(**options))
        self.kernels: Kernels | None = None

    def forward(self, y: Tensor, sensors: Tensor, which: Tensor) -> Tensor:
        """Value at each row.

        Args:
            y: trunk inputs, (R, trunk_inputs).
            sensors: distinct branch inputs, (C, S): the branch runs once for each.
            which: the branch input of each row, (R,).

        Returns:
            Shape (R,).
        """
        return torch.linalg.vecdot(self.trunk(y), self.branch(sensors)[which])

    def value_gradient(self, y: Tensor, sensors: Tensor, which: Tensor) -> tuple[Tensor, Tensor]:
        """Value at each row and its gradient in y, (R,) and (R, trunk_inputs), both differentiable in the parameters.

        The branch's output is folded into the trunk's last layer: rows of one branch input share a linear map.
        Arguments as in `forward`.
        """
        hidden, last = self.trunk.folded()
        branch = self.branch(sensors)
        activation, coefficient = type(self.trunk.activation), branch @ last.weight
        value, gradient = value_gradient(activation, y, which, coefficient, hidden, self.kernels)
        return value + (branch @ last.bias)[which], gradient


class Ensemble(nn.Module):
    """Several nets, and the median of their values.

    Where two equilibria cost nearly the same, each net rounds off the ridge between them in its own way; the median
    follows the majority.

    Args:
        members: an odd number of them.
    """

    def __init__(self, members: Iterable[DeepONet]) -> None:
        super().__init__()
        self.members = nn.ModuleList(members)

    def forward(self, y: Tensor, sensors: Tensor, which: Tensor) -> Tensor:
        """Median value at each row, (R,); arguments as of a member."""
        return torch.stack([net(y, sensors, which) for net in self.members]).median(0).values


def median_of(members: int, make: Callable[[], DeepONet]) -> DeepONet | Ensemble:
    """One net, or several with weights of their own.

    Args:
        members: how many, an odd number.
        make: builds one.

    Raises:
        ValueError: `members` is no odd whole number.
    """
    if not (type(members) is int and members > 0 and members % 2):
        raise ValueError(
            f"operator.members must be an odd whole number, such as 1 or 3, so that there is a median; got {members!r}."
        )
    return make() if members == 1 else Ensemble(make() for _ in range(members))


def nets(net: DeepONet | Ensemble) -> list[DeepONet]:
    """The members of an ensemble, or the net itself."""
    return cast(list[DeepONet], list(net.members)) if isinstance(net, Ensemble) else [net]
