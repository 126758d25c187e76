"""What other people bring: activations that define a function alone, networks that know no gradient."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest
import torch
from torch import Tensor, nn

from hno.games import make
from hno.operators import Network, activations
from hno.operators.activations import Activation
from hno.operators.deeponet import DeepONet
from hno.operators.gradient import GradientOperator
from hno.operators.network import Inputs
from hno.types import Field, Points
from tests.operators.conftest import ACTIVATIONS, GAMES, MakeModule, module_of, random_batch, random_points

TIGHT = {"rtol": 1e-10, "atol": 1e-10}


class SiLU(Activation):
    """z sigmoid(z)."""

    @staticmethod
    def core(u: Tensor) -> Tensor:
        return nn.functional.silu(u)


class GELU(Activation):
    """z Phi(z)."""

    @staticmethod
    def core(u: Tensor) -> Tensor:
        return nn.functional.gelu(u)


class Plain(Network):
    """A network that is no DeepONet and leaves its gradient to autograd."""

    def __init__(self, inputs: Inputs, width: int = 12) -> None:
        super().__init__()
        sizes = inputs.total + inputs.sensors, width
        self.layers = nn.Sequential(nn.Linear(*sizes), nn.Softplus(), nn.Linear(width, width), nn.Tanh())
        self.last = nn.Linear(width, 1)

    def forward(self, y: Tensor, sensors: Tensor, which: Tensor) -> Tensor:
        return self.last(self.layers(torch.cat([y, sensors[which]], -1))).squeeze(-1)


NETWORKS: dict[str, Callable[[Inputs], Network]] = {
    "SiLU": partial(DeepONet, activation=SiLU, width=10, depth=2),
    "GELU": partial(DeepONet, activation=GELU, width=10, depth=2),
    "plain": Plain,
}


def operator_of(network: str, game: str = "lane_change", *, exact: bool = True, members: int = 1) -> GradientOperator:
    torch.manual_seed(0)
    operator = GradientOperator(make(game), NETWORKS[network], exact_terminal=exact, members=members).double()
    operator.value_scale.fill_(40.0)
    return operator


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("game", GAMES)
@pytest.mark.parametrize("exact", [True, False])
def test_field_is_the_jacobian_of_the_value(network: str, game: str, exact: bool) -> None:
    operator = operator_of(network, game, exact=exact)
    points = random_points(operator.game, 4)
    field = operator.field(points)
    value = lambda tau, x, theta: operator.value(tau[None], x[None], theta[None])[0]  # noqa: E731  # for jacrev
    for row, at in enumerate(zip(*points, strict=True)):
        in_time, in_state = torch.func.jacrev(value, argnums=(0, 1))(*at)
        torch.testing.assert_close(field.value[row], value(*at), **TIGHT)
        torch.testing.assert_close(field.dvalue_dtau[row], in_time, **TIGHT)
        torch.testing.assert_close(field.costate[row], in_state, **TIGHT)


@pytest.mark.parametrize("network", NETWORKS)
def test_field_agrees_with_finite_differences(network: str) -> None:
    operator, step = operator_of(network), 1e-6
    tau, x, theta = random_points(operator.game, 3)
    field = operator.field(Points(tau, x, theta))
    for player in range(2):
        for state in range(4):
            moved = torch.zeros_like(x)
            moved[:, player, state] = step
            slope = (operator(tau, x + moved, theta) - operator(tau, x - moved, theta)) / (2 * step)
            torch.testing.assert_close(field.costate[:, :, player, state], slope, rtol=1e-5, atol=1e-6)
    slope = (operator(tau + step, x, theta) - operator(tau - step, x, theta)) / (2 * step)
    torch.testing.assert_close(field.dvalue_dtau, slope, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("network", NETWORKS)
def test_derivatives_in_the_weights_agree_with_finite_differences(network: str) -> None:
    """Of costates too, along a random direction of all weights at once."""
    operator, step = operator_of(network), 1e-6
    points, weights = random_points(operator.game, 5), list(operator.parameters())
    torch.manual_seed(1)
    direction = [torch.randn_like(weight) for weight in weights]

    def total(field: Field) -> Tensor:
        return torch.stack([part.sin().sum() for part in field]).sum()

    slopes = torch.autograd.grad(total(operator.field(points)), weights)
    found = sum(float((slope * d).sum()) for slope, d in zip(slopes, direction, strict=True))
    ends = []
    for sign in (1, -1):
        with torch.no_grad():
            for weight, d in zip(weights, direction, strict=True):
                weight.add_(sign * step * d)
            ends.append(float(total(operator.field(points))))
            for weight, d in zip(weights, direction, strict=True):
                weight.sub_(sign * step * d)
    assert found == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-5)
    assert abs(found) > 1e-3


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("quiet", [torch.no_grad, torch.inference_mode])
def test_field_needs_no_gradients_from_outside(network: str, quiet: Callable[[], torch.no_grad]) -> None:
    operator = operator_of(network, members=3)
    points = random_points(operator.game)
    with quiet():
        inside = operator.field(Points(*(part.clone() for part in points)))
    assert not any(part.requires_grad for part in inside)
    for part, other in zip(inside, operator.field(points), strict=True):  # derivatives in graphs round in their own way
        torch.testing.assert_close(part, other, **TIGHT)


@pytest.mark.parametrize("network", NETWORKS)
def test_it_trains(make_module: MakeModule, network: str) -> None:
    make_module()  # nobody logs
    module = module_of(operator_of(network).float(), "hno")
    batch = random_batch(module.operator.game, 32)
    optimizer, losses = torch.optim.Adam(module.operator.parameters(), lr=3e-3), []
    for step in range(40):
        optimizer.zero_grad()
        loss = module.training_step(batch, step)
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.95 * losses[0]


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_the_fast_way_is_that_of_autograd(activation: str) -> None:
    """Value, gradient and their derivatives in every parameter of the DeepONet, to rounding."""
    torch.manual_seed(0)
    network = DeepONet(Inputs(5, 4, 1, 0, 7), activations.get(activation), width=8, depth=3).double()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(1.1).add_(0.013)
    y, sensors, which = torch.randn(11, 9).double(), torch.randn(3, 7).double(), torch.arange(11) % 3
    weights = torch.randn(11, 10).double()
    results = []
    for way in (DeepONet.value_gradient, Network.value_gradient):
        joint = torch.cat([part.reshape(11, -1) for part in way(network, y, sensors, which)], -1)
        slopes = torch.autograd.grad((weights * joint).sum(), list(network.parameters()), materialize_grads=True)
        results.append((joint, *slopes))
    for fast, plain in zip(*results, strict=True):
        torch.testing.assert_close(fast, plain, **TIGHT)
