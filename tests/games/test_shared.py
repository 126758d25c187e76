"""What all games share: final methods, defaults that subclasses may replace, boxes of one player or of each."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from torch import Tensor

from hno.games import Box, CollisionAvoidance, ControlAffineGame, Game, make
from hno.games.kinematics import distances, unicycle_drift
from hno.games.testing import check_game
from tests.lq import random_game
from tests.walkers import Walkers

FINGERPRINTS = {
    "narrow_road": ("8534716afe609a11", "3052bf9153a12897"),
    "lane_change": ("58031a18c2b4362c", "987e1e26c07602bf"),
    "drone": ("46b157d2372ea855", "4627b60bcce8b9e4"),
}
"""With the default constants, and with a horizon of 2 s: labels are cached under them."""


@pytest.mark.parametrize("name", FINGERPRINTS)
def test_fingerprints_stay_so_that_cached_labels_stay_valid(name):
    assert (make(name).fingerprint(), make(name, horizon=2.0).fingerprint()) == FINGERPRINTS[name]


@pytest.mark.parametrize("name", Game.INSTEAD)
def test_a_game_that_overrides_a_final_method_is_refused_with_what_to_override(name):
    with pytest.raises(
        TypeError, match=f"Broken overrides {name}, which is final: set or override {Game.INSTEAD[name]}"
    ):
        type("Broken", (Game,), {name: None})
    with pytest.raises(TypeError, match=f"Broken overrides {name}"):
        type("Broken", (CollisionAvoidance,), {name: None})


@pytest.mark.parametrize("name", ControlAffineGame.INSTEAD)
def test_what_a_control_affine_game_derives_is_final_there_and_open_elsewhere(name):
    instead = ControlAffineGame.INSTEAD[name]
    with pytest.raises(TypeError, match=f"Broken overrides {name}, which is final: set or override {instead}"):
        type("Broken", (ControlAffineGame,), {name: None})
    type("Sound", (Game,), {name: None})


def test_a_mixin_cannot_override_either():
    mixin = type("Mixin", (), {"running_cost": None})
    with pytest.raises(TypeError, match="Broken overrides running_cost"):
        type("Broken", (mixin, ControlAffineGame), {})


@pytest.mark.parametrize("name", ["horizon", "state_box", "initial_box", "control_box", "type_box"])
def test_a_forgotten_attribute_is_named(name):
    game = Walkers()
    if name == "horizon":
        game = type("Endless", (ControlAffineGame,), dict.fromkeys(ControlAffineGame.__abstractmethods__))()
    else:
        delattr(game, name)
    with pytest.raises(AttributeError, match=f"has no {name}; every game sets horizon, state_box"):
        getattr(game, {"state_box": "state_dim", "control_box": "control_dim"}.get(name, name))


@pytest.mark.parametrize(
    ("name", "constants"),
    [
        ("narrow_road", {"radius": -1}),
        ("lane_change", {"speed": -18}),
        ("drone", {"width": 0}),
        ("drone", {"horizon": -1}),
    ],
)
def test_constants_that_must_be_positive(name, constants):
    with pytest.raises(ValueError, match=f"needs a positive {next(iter(constants))}; got"):
        make(name, **constants)


class Bicycles(ControlAffineGame):
    """Kinematic bicycles (px, py, heading, speed) of different make, which keep to a line."""

    horizon = 1.0
    roles = (0, 1)
    periodic = (2,)

    def __init__(self) -> None:
        super().__init__()
        self.state_box = Box([[-9, -9, -math.pi, 0.5]] * 2, [[9, 9, math.pi, 6]] * 2)
        self.initial_box = Box([[-1, -1, -1, 1], [2, -1, -1, 1]], [[1, 1, 1, 3], [4, 1, 1, 3]])
        self.control_box = Box([[-0.4, -1], [-0.2, -3]], [[0.4, 2], [0.2, 3]])
        self.type_box = Box([0, 0], [1, 1])
        self.register_buffer("effort_weight", torch.tensor([[1.0, 2.0], [3.0, 0.5]]))
        self.register_buffer("length", torch.tensor([1.0, 2.5]))

    def drift(self, x: Tensor) -> Tensor:
        return unicycle_drift(x)

    def affine_input(self, u: Tensor) -> Tensor:
        return torch.cat([u[..., :1].tan(), u[..., 1:]], -1)

    def control_of(self, w: Tensor) -> Tensor:
        return torch.cat([w[..., :1].atan(), w[..., 1:]], -1)

    def control_matrix(self, x: Tensor) -> Tensor:
        turning = torch.zeros(*x.shape, 2, dtype=x.dtype, device=x.device)
        turning[..., 2, 0] = x[..., 3] / self.length
        turning[..., 3, 1] = 1
        return turning

    def positions(self, x: Tensor) -> Tensor:
        return x[..., :2]

    def constraint(self, x: Tensor, theta: Tensor) -> Tensor:
        return 0.2 - distances(self.positions(x))

    def state_cost(self, x: Tensor, theta: Tensor) -> Tensor:
        return (x[..., 1] - theta).square()

    def terminal_value(self, x: Tensor) -> Tensor:
        return -(x[..., 3] - 2).square() - 10 * (1 - x[..., 2].cos())


def test_bicycles_keep_the_contract():
    """State-dependent control matrix, boxes, efforts and goals of their own, a heading that wraps, a state cost."""
    check_game(Bicycles())


@pytest.mark.parametrize("scale", [1.0, 30.0])
def test_the_vertex_of_each_player_is_clamped_to_its_own_box(scale):
    game = Bicycles().double()
    x = game.state_box.sample(64, torch.Generator().manual_seed(0))
    own = scale * torch.randn(x.shape, generator=torch.Generator().manual_seed(1), dtype=x.dtype)
    u = game.best_response(x, own)
    tangent = own[..., 2] * x[..., 3] / torch.tensor([1.0, 2.5]) / (2 * torch.tensor([1.0, 3.0]))
    expected = torch.stack([tangent.atan(), own[..., 3] / (2 * torch.tensor([2.0, 0.5]))], -1)
    torch.testing.assert_close(u, game.control_box.clamp(expected))
    at_bound = (u == game.control_box.lo) | (u == game.control_box.hi)
    assert at_bound.any()
    assert scale > 1 or not at_bound.all()


def test_one_box_for_all_is_the_same_box_for_each():
    game, wide = Walkers().double(), Walkers().double()
    wide.control_box = Box([[-6, -6]] * 2, [[6, 6]] * 2).double()
    wide.effort_weight = game.effort_weight.expand(2, -1).clone()
    wide.input_matrix = game.input_matrix.expand(2, -1, -1).clone()
    x = game.state_box.sample(8, torch.Generator().manual_seed(0))
    own = 20 * torch.randn(x.shape, generator=torch.Generator().manual_seed(1), dtype=x.dtype)
    u = game.best_response(x, own)
    assert torch.equal(wide.best_response(x, own), u)
    torch.testing.assert_close(wide.dynamics(x, u), game.dynamics(x, u))
    torch.testing.assert_close(wide.effort(u), game.effort(u))
    check_game(wide)


@pytest.mark.parametrize("players", [1, 2, 3, 4])
def test_default_sensors_tell_types_apart_and_swap_with_the_players(players):
    game = random_game(players)
    theta = game.type_box.sample(16, torch.Generator().manual_seed(0))
    found = game.sensors(theta)
    assert found.shape == (16, players, players)
    torch.testing.assert_close(found[..., 0], 2 * theta - 1)
    for order in itertools.permutations(range(players)):
        torch.testing.assert_close(game.sensors(theta[:, order]), found[:, order])
    assert not found.flatten(1).unique(dim=0).shape[0] < 16
