"""A DeepONet in dimensionless units (paper, eq. 7)."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import final

import torch
from torch import Tensor, nn

from hno.operators.activations import Activation, ClosedFormActivation
from hno.operators.network import Inputs, Network, networks
from hno.operators.value_gradient import Kernels, Layer, compiled, value_gradient

TABLE = 512
"""Branch inputs up to which values are computed for all of them."""


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


WIDEST, DEEPEST = 4096, 100
"""Sizes beyond which a net is a slip of the pen, or a file that is to fill the memory."""


@final
@networks.register("deeponet")
class DeepONet(Network):
    """sum_k branch_k(a) trunk_k(y).

    With several other players, the trunk sees the mean of what one shared net makes of each of them together with the
    player itself (deep sets, Zaheer et al. 2017), so that their order does not matter.

    Args:
        inputs: sizes.
        activation: makes the activation of each net.
        width: hidden and output width.
        depth: hidden layers.

    Raises:
        ValueError: `width` or `depth` is below 1, or above `WIDEST` or `DEEPEST`.
    """

    def __init__(self, inputs: Inputs, activation: Callable[[], Activation], width: int = 64, depth: int = 4) -> None:
        for name, size, most in (("width", width, WIDEST), ("depth", depth, DEEPEST)):
            if not 1 <= size <= most:
                raise ValueError(f"network.{name} must be a whole number from 1 to {most}; got {size!r}.")
        super().__init__()
        self.inputs = inputs
        hidden, several = (width,) * (depth + 1), inputs.others > 1
        ego = inputs.ego + inputs.role
        self.trunk = MLP((ego + width if several else inputs.total, *hidden), activation())
        self.branch = MLP((inputs.sensors, *hidden), activation())
        self.pair = MLP((ego + inputs.other, width, width), activation()) if several else None
        self.kernels: Kernels | None = None

    def forward(self, y: Tensor, sensors: Tensor, which: Tensor) -> Tensor:
        """Value at each row, (R,)."""
        return torch.linalg.vecdot(self.trunk(self._pooled(y)), self.branch(sensors)[which])

    def values(self, y: Tensor, sensors: Tensor, which: Tensor) -> Tensor:
        """Values at each row for several branch inputs: the trunk runs once.

        Where several rows share them and there are few, one product gives the values for all, and each row takes its
        own: the derivative of that costs less than that of a look-up of coefficients.
        """
        hidden, last = self.trunk.folded()
        h, branch = self._pooled(y), self.branch(sensors)
        for weight, bias in hidden:
            h = self.trunk.activation.core(torch.addmm(bias, h, weight.mT))
        coefficient, shift = branch @ last.weight, branch @ last.bias
        if len(branch) > min(TABLE, which.numel() - 1):
            return torch.linalg.vecdot(h.unsqueeze(-2), coefficient[which]) + shift[which]
        return (h @ coefficient.mT + shift).gather(-1, which)

    def value_gradient(self, y: Tensor, sensors: Tensor, which: Tensor) -> tuple[Tensor, Tensor]:
        """Value at each row and its gradient in y.

        With one other player and an activation that knows its derivatives it is one pass forward and one backward
        (`hno.operators.value_gradient`). The branch's output is folded into the trunk's last layer: rows of one branch
        input share a linear map.
        """
        activation = self.trunk.activation
        if self.pair is not None or not isinstance(activation, ClosedFormActivation):
            return super().value_gradient(y, sensors, which)
        hidden, last = self.trunk.folded()
        branch = self.branch(sensors)
        coefficient = branch @ last.weight
        value, gradient = value_gradient(type(activation), y.detach(), which, coefficient, hidden, self.kernels)
        return value + (branch @ last.bias)[which], gradient

    def compile_kernels(self) -> None:
        """Train through `torch.compile`."""
        self.kernels = compiled()

    def _pooled(self, y: Tensor) -> Tensor:
        """What the trunk sees, (R, trunk inputs)."""
        if self.pair is None:
            return y
        sizes = self.inputs
        own, others, role = y.split([sizes.ego, sizes.others * sizes.other, sizes.role], -1)
        ego = torch.cat([own, role], -1)
        blocks = others.unflatten(-1, (sizes.others, sizes.other))
        pairs = torch.cat([ego.unsqueeze(1).expand(-1, sizes.others, -1), blocks], -1)
        return torch.cat([ego, self.pair(pairs).mean(1)], -1)
