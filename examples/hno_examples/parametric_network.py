"""A network of one's own: the parametric baseline, one net that takes the types as plain inputs, without a branch."""

from __future__ import annotations

from collections.abc import Callable
from typing import final

import torch
from torch import Tensor

from hno.operators import Network
from hno.operators.activations import Activation
from hno.operators.deeponet import MLP
from hno.operators.network import Inputs


@final
class Parametric(Network):
    """MLP(y, a): scaled time and states and the branch input side by side.

    Its gradient in y comes from autograd, which is what `Network` does by itself.

    Args:
        inputs: sizes.
        activation: makes an activation.
        width: of the hidden layers.
        depth: hidden layers.

    Raises:
        ValueError: several other players, whose order would matter.
    """

    def __init__(self, inputs: Inputs, activation: Callable[[], Activation], width: int = 64, depth: int = 4) -> None:
        super().__init__()
        if inputs.others > 1:
            raise ValueError(f"The parametric network is for one other player; this game has {inputs.others}.")
        self.mlp = MLP((inputs.total + inputs.sensors, *[width] * depth, 1), activation())

    def forward(self, y: Tensor, sensors: Tensor, which: Tensor) -> Tensor:
        """Value at each row, (R,)."""
        return self.mlp(torch.cat([y, sensors[which]], -1)).squeeze(-1)
