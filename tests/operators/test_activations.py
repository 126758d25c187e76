from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from hno.operators import activations
from hno.operators.deeponet import MLP, DeepONet
from hno.operators.network import Inputs
from tests.operators.conftest import ACTIVATIONS

INPUTS = Inputs(ego=5, other=4, others=1, role=0, sensors=50)
PLAIN = {"tanh": torch.tanh, "relu": torch.relu, "sin": lambda z: torch.sin(10 * z)}


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_initial_slope_gives_the_plain_function(name: str) -> None:
    z = torch.linspace(-2, 2, 101)
    activation = activations.get(name)()
    assert activation.slope.item() == pytest.approx(0.1)
    torch.testing.assert_close(activation(z), PLAIN[name](z), rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_slope_stretches_the_argument(name: str) -> None:
    z = torch.linspace(-2, 2, 101)
    activation = activations.get(name)()
    with torch.no_grad():
        activation.slope.fill_(0.17)
    torch.testing.assert_close(activation(z), PLAIN[name](1.7 * z), rtol=1e-4, atol=1e-4)


@pytest.fixture
def layer() -> nn.Linear:
    torch.manual_seed(0)
    return nn.Linear(300, 500)


def test_tanh_weights_are_xavier(layer: nn.Linear) -> None:
    activations.get("tanh")().init_(layer, first=False)
    assert layer.weight.std().item() == pytest.approx(math.sqrt(2 / 800), rel=0.02)
    assert layer.weight.mean().abs().item() < 1e-3
    assert not layer.bias.any()


def test_relu_weights_are_kaiming(layer: nn.Linear) -> None:
    activations.get("relu")().init_(layer, first=False)
    assert layer.weight.std().item() == pytest.approx(math.sqrt(2 / 300), rel=0.02)
    assert layer.weight.mean().abs().item() < 1e-3
    assert not layer.bias.any()


@pytest.mark.parametrize(("first", "bound"), [(True, 1 / 300), (False, math.sqrt(6 / 300) / 10)])
def test_sin_weights_are_uniform_within_the_siren_bounds(layer: nn.Linear, first: bool, bound: float) -> None:
    activations.get("sin")().init_(layer, first=first)
    weights = layer.weight.flatten()
    assert weights.abs().max().item() <= bound
    assert weights.abs().max().item() > 0.99 * bound
    assert weights.std().item() == pytest.approx(bound / math.sqrt(3), rel=0.02)
    assert layer.bias.abs().max().item() <= bound


def test_sin_keeps_the_size_of_phases_through_the_layers() -> None:
    torch.manual_seed(0)
    net, phases = MLP((16, 256, 256, 256, 256), activations.get("sin")()), []
    for layer in net.layers[1:]:
        layer.register_forward_hook(lambda module, arguments, output: phases.append(10 * output))
    net(2 * torch.rand(500, 16) - 1)
    assert [phase.std().item() for phase in phases] == pytest.approx([1.0] * 3, rel=0.25)


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_relu_and_tanh_signals_neither_vanish_nor_explode(name: str) -> None:
    torch.manual_seed(0)
    output = MLP((16, 64, 64, 64, 64, 64), activations.get(name)())(2 * torch.rand(500, 16) - 1)
    assert 0.02 < output.std().item() < 5


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_one_slope_for_the_trunk_and_one_for_the_branch(name: str) -> None:
    net = DeepONet(INPUTS, activations.get(name))
    slopes = [parameter for key, parameter in net.named_parameters() if key.endswith("slope")]
    assert len(slopes) == 2
    assert slopes[0].data_ptr() != slopes[1].data_ptr()
    with torch.no_grad():
        slopes[0].add_(1)
    assert slopes[1].item() == pytest.approx(0.1)


def test_four_hidden_layers_of_64() -> None:
    net = DeepONet(INPUTS, activations.get("tanh"))
    shapes = [tuple(layer.weight.shape) for layer in net.trunk.layers]
    assert shapes == [(64, 9), (64, 64), (64, 64), (64, 64), (64, 64)]
    assert tuple(net.branch.layers[0].weight.shape) == (64, 50)
