"""Activations with one trainable slope per net (Jagtap et al. 2020) and the initialisation that suits each."""

from __future__ import annotations

import abc
import math
from typing import ClassVar, final

import torch
from torch import Tensor, nn

from hno.registry import Registry

activations: Registry[Activation] = Registry("activation", "hno.operators", base="hno.operators.activations:Activation")


class Activation(nn.Module, abc.ABC):
    """phi(10 a z) with a trainable slope a, initially 0.1, shared by all layers of one net.

    An activation of your own defines `core` alone; constructor arguments are options. Its initialisation is Xavier's
    unless it overrides `init_`.

    It is a core between two affine maps, gain * core(factor * z) + shift. A net folds the maps into its weights, so
    that only the core is left to do for every row: tanh costs what a sigmoid does, much less than `torch.tanh`.
    """

    gain: ClassVar[float] = 1.0
    shift: ClassVar[float] = 0.0

    def __init__(self) -> None:
        super().__init__()
        self.slope = nn.Parameter(torch.tensor(0.1))

    @property
    def factor(self) -> Tensor:
        """What the core's argument is multiplied with, scalar: 10 a, times a constant where the core needs one."""
        return 10 * self.slope

    def forward(self, z: Tensor) -> Tensor:
        """Pointwise, any shape."""
        return self.gain * self.core(self.factor * z) + self.shift

    @staticmethod
    @abc.abstractmethod
    def core(u: Tensor) -> Tensor:
        """The elementary function, any shape."""

    def init_(self, layer: nn.Linear, *, first: bool) -> None:
        """Initialise one linear layer in place: Xavier normal weights, zero bias.

        Args:
            layer: the layer.
            first: whether it reads the net's input.
        """
        nn.init.xavier_normal_(layer.weight)
        nn.init.zeros_(layer.bias)


class ClosedFormActivation(Activation):
    """An activation whose core's second derivative is a function of its value and its derivative.

    Training is then faster: see `hno.operators.value_gradient`.
    """

    @staticmethod
    @abc.abstractmethod
    def core_and_first_(u: Tensor) -> tuple[Tensor, Tensor]:
        """The core and its derivative at `u`, whose memory they may overwrite."""

    @staticmethod
    @abc.abstractmethod
    def times_second_(x: Tensor, core: Tensor, first: Tensor) -> Tensor:
        """Multiply `x` by the core's second derivative, in place, given its value and its derivative."""


@final
@activations.register("tanh")
class Tanh(ClosedFormActivation):
    """Hyperbolic tangent, tanh(z) = 2 sigmoid(2 z) - 1; Xavier initialisation."""

    gain = 2.0
    shift = -1.0

    @property
    def factor(self) -> Tensor:
        """20 a."""
        return 20 * self.slope

    @staticmethod
    def core(u: Tensor) -> Tensor:
        """Sigmoid."""
        return torch.sigmoid(u)

    @staticmethod
    def core_and_first_(u: Tensor) -> tuple[Tensor, Tensor]:
        """The derivative is s - s^2."""
        core = u.sigmoid_()
        return core, torch.addcmul(core, core, core, value=-1)

    @staticmethod
    def times_second_(x: Tensor, core: Tensor, first: Tensor) -> Tensor:
        """The second derivative is (s - s^2) (1 - 2 s)."""
        x.mul_(first)
        return x.addcmul_(x, core, value=-2)


@final
@activations.register("relu")
class ReLU(ClosedFormActivation):
    """Rectified linear unit, Kaiming initialisation."""

    @staticmethod
    def core(u: Tensor) -> Tensor:
        """max(u, 0)."""
        return torch.relu(u)

    @staticmethod
    def core_and_first_(u: Tensor) -> tuple[Tensor, Tensor]:
        """The derivative is 1 where u > 0, otherwise 0."""
        first = (u > 0).to(u.dtype)
        return u.relu_(), first

    @staticmethod
    def times_second_(x: Tensor, core: Tensor, first: Tensor) -> Tensor:
        """The second derivative is 0: costates do not change between kinks."""
        return x.zero_()

    def init_(self, layer: nn.Linear, *, first: bool) -> None:
        """Kaiming normal weights, zero bias."""
        nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
        nn.init.zeros_(layer.bias)


@final
@activations.register("sin")
class Sin(ClosedFormActivation):
    """Sine with the SIREN initialisation (Sitzmann et al. 2020).

    Args:
        frequency: omega_0, which multiplies every pre-activation; it was published with 30.
    """

    def __init__(self, frequency: float = 10.0) -> None:
        super().__init__()
        if not (math.isfinite(frequency) and frequency > 0):
            raise ValueError(f"activation.frequency must be a positive number; got {frequency!r}.")
        self.frequency = frequency

    @property
    def factor(self) -> Tensor:
        """10 a omega_0."""
        return 10 * self.frequency * self.slope

    @staticmethod
    def core(u: Tensor) -> Tensor:
        """Sine."""
        return torch.sin(u)

    @staticmethod
    def core_and_first_(u: Tensor) -> tuple[Tensor, Tensor]:
        """The derivative is the cosine."""
        first = torch.cos(u)
        return u.sin_(), first

    @staticmethod
    def times_second_(x: Tensor, core: Tensor, first: Tensor) -> Tensor:
        """The second derivative is minus the sine."""
        return x.mul_(core).neg_()

    def init_(self, layer: nn.Linear, *, first: bool) -> None:
        """Uniform weights that keep the variance of the phases, the same bounds for biases."""
        fan_in = layer.in_features
        bound = 1 / fan_in if first else math.sqrt(6 / fan_in) / self.frequency
        nn.init.uniform_(layer.weight, -bound, bound)
        nn.init.uniform_(layer.bias, -bound, bound)
