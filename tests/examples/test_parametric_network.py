from __future__ import annotations

import pytest
import torch
from hno_examples.parametric_network import Parametric
from hno_examples.three_walkers import ThreeWalkers

import hno
from hno.games import make
from hno.operators import Architecture, Choice, make_operator
from hno.registry import UnknownNameError
from hno.training.checkpoint import Provenance, record
from hno.types import Points
from tests.examples.conftest import Train

pytestmark = pytest.mark.usefixtures("installed")
OPTIONS = {"width": 32, "depth": 2}


def test_its_costates_are_the_gradients_of_its_values():
    game = make("tracking")
    operator = make_operator(game, Architecture(network=Choice("parametric", OPTIONS))).double()
    x, theta = (box.sample(5, torch.Generator().manual_seed(0)) for box in (game.state_box, game.type_box))
    tau, x, theta = torch.linspace(0, 3, 5).double(), x.double().requires_grad_(), theta.double()
    costate = operator.field(Points(tau, x.detach(), theta)).costate
    value = operator.value(tau, x, theta)
    for player in range(2):
        (slope,) = torch.autograd.grad(value[:, player].sum(), x, retain_graph=True)
        torch.testing.assert_close(costate[:, player], slope)


def test_it_sees_the_types():
    operator = make_operator(make("tracking"), Architecture(network=Choice("parametric", OPTIONS)))
    at = torch.tensor([1.0]), torch.tensor([[[6.0, 0.1], [6.0, 0.2]]])
    values = [operator.value(*at, torch.tensor([theta])) for theta in ([1.0, 1.0], [5.0, 5.0])]
    assert (values[0] != values[1]).all()


def test_unknown_options_and_several_players_are_refused():
    with pytest.raises(UnknownNameError, match="Did you mean 'width'"):
        make_operator(make("tracking"), Architecture(network=Choice("parametric", {"widht": 16})))
    with pytest.raises(ValueError, match="one other player; this game has 2"):
        make_operator(ThreeWalkers(), Architecture(network=Choice("parametric")))


def test_trains_and_is_loaded_with_its_options(train: Train):
    trained = train(
        make("tracking"),
        [(1, 1), (5, 5)],
        network=Choice("parametric", OPTIONS),
        steps=150,
        record=lambda game, architecture: record(game, architecture, Provenance("sno")),
    )
    assert trained.after < 0.5 * trained.before
    (network,) = hno.load_policy(trained.fitted.checkpoint).operator.networks
    assert isinstance(network, Parametric)
    assert [layer.out_features for layer in network.mlp.layers] == [32, 32, 1]
