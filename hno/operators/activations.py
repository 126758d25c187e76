"""Activations with one trainable slope per net (Jagtap et al. 2020) and the initialisation that suits each."""

from __future__ import annotations

import abc
import math
from typing import final

import torch
from torch import Tensor, nn

from hno.registry import Registry

activations: Registry[Activation] = Registry("activation", "hno.operators")


class Activation(nn.Module, abc.ABC):
    """phi(10 a z) with a trainable slope a, initially 0.1, shared by all layers of one net."""

    def __init__(self) -> None:
        super().__init__()
        self.slope = nn.Parameter(torch.tensor(0.1))

    @abc.abstractmethod
    def forward(self, z: Tensor) -> Tensor:
        """Pointwise, any shape."""

    @abc.abstractmethod
    def init_(self, layer: nn.Linear, *, first: bool) -> None:
        """Initialise one linear layer in place.

        Args:
            layer: the layer.
            first: whether it reads the net's input.
        """


@final
@activations.register("tanh")
class Tanh(Activation):
    """Hyperbolic tangent, Xavier initialisation."""

    def forward(self, z: Tensor) -> Tensor:
        """tanh(10 a z)."""
        return torch.tanh(10 * self.slope * z)

    def init_(self, layer: nn.Linear, *, first: bool) -> None:
        """Xavier normal weights, zero bias."""
        nn.init.xavier_normal_(layer.weight)
        nn.init.zeros_(layer.bias)


@final
@activations.register("relu")
class ReLU(Activation):
    """Rectified linear unit, Kaiming initialisation."""

    def forward(self, z: Tensor) -> Tensor:
        """max(10 a z, 0)."""
        return torch.relu(10 * self.slope * z)

    def init_(self, layer: nn.Linear, *, first: bool) -> None:
        """Kaiming normal weights, zero bias."""
        nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
        nn.init.zeros_(layer.bias)


@final
@activations.register("sin")
class Sin(Activation):
    """Sine with the SIREN initialisation (Sitzmann et al. 2020).

    Args:
        frequency: omega_0, which multiplies every pre-activation.
    """

    def __init__(self, frequency: float = 30.0) -> None:
        super().__init__()
        self.frequency = frequency

    def forward(self, z: Tensor) -> Tensor:
        """sin(10 a omega_0 z)."""
        return torch.sin(10 * self.frequency * self.slope * z)

    def init_(self, layer: nn.Linear, *, first: bool) -> None:
        """Uniform weights that keep the variance of the phases, the same bounds for biases."""
        fan_in = layer.in_features
        bound = 1 / fan_in if first else math.sqrt(6 / fan_in) / self.frequency
        nn.init.uniform_(layer.weight, -bound, bound)
        nn.init.uniform_(layer.bias, -bound, bound)
