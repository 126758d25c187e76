"""The games of the paper against its formulas, written out here once more (paper, sec. IV)."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from torch import Tensor

from hno.games import Game, make

NAMES = ("narrow_road", "lane_change", "drone")
TYPES = torch.tensor(list(itertools.product(range(1, 6), repeat=2)), dtype=torch.float64)
BASE_RADIUS = {"narrow_road": 1.25, "lane_change": 2.25, "drone": 0.5}
G = 9.81


def radius(name: str, theta: Tensor) -> Tensor:
    first, second = theta.unbind(-1)
    return 0.1 * (first + second) + 0.05 * torch.minimum(first, second) + BASE_RADIUS[name]


def distance(name: str, x: Tensor) -> Tensor:
    one, two = x.unbind(-2)
    if name == "narrow_road":
        return torch.hypot((70 - two[..., 0]) - one[..., 0], two[..., 1] - one[..., 1])
    if name == "lane_change":
        return torch.hypot(two[..., 0] - one[..., 0], two[..., 1] - one[..., 1])
    gaps = (5 - two[..., 0]) - one[..., 0], (5 - two[..., 1]) - one[..., 1], two[..., 2] - one[..., 2]
    return torch.stack(gaps, -1).square().sum(-1).sqrt()


def terminal_cost(name: str, x: Tensor) -> Tensor:
    if name == "drone":
        px, py, pz, vx, vy, vz = x.unbind(-1)
        return -1e-6 * (px + py) + pz**2 + vx**2 + vy**2 + vz**2
    px, py, psi, v = x.unbind(-1)
    if name == "narrow_road":
        return -1e-6 * px + (v - 18) ** 2 + (py - 4) ** 2
    lanes = torch.tensor([6.0, 2.0], dtype=x.dtype)
    return -1e-6 * px + (py - lanes) ** 2 + (v - 18) ** 2 + 100 * psi**2


@pytest.fixture(params=NAMES)
def name(request) -> str:
    return request.param


@pytest.fixture
def game(name) -> Game:
    return make(name).double()


@pytest.fixture
def states(game) -> Tensor:
    return game.state_box.sample(len(TYPES), torch.Generator().manual_seed(0))


def test_radii_at_the_types_that_the_facts_name(name, game, states):
    theta = torch.tensor([[1.0, 1.0], [1.0, 5.0], [5.0, 5.0]], dtype=torch.float64)
    found = game.constraint(states[:3], theta)[:, 0, 0] + distance(name, states[:3])
    assert (found - BASE_RADIUS[name] + 1.25).tolist() == pytest.approx([1.5, 1.9, 2.5])


def test_constraint_is_radius_minus_distance_at_every_type(name, game, states):
    expected = (radius(name, TYPES) - distance(name, states))[:, None, None].expand(-1, 2, 1)
    torch.testing.assert_close(game.constraint(states, TYPES), expected, rtol=0, atol=1e-9)


def test_the_radius_of_a_row_is_that_of_its_own_types(game, states):
    batched = game.constraint(states, TYPES)
    alone = torch.stack([game.constraint(x, theta) for x, theta in zip(states, TYPES, strict=True)])
    torch.testing.assert_close(batched, alone, rtol=0, atol=1e-12)
    same_place = game.constraint(states[:1].expand_as(states), TYPES)
    assert len(same_place[:, 0].mul(1e6).round().unique()) == 15


def test_penalty_is_the_sigmoid_of_the_paper(name, game, states):
    exponent = -5 * (radius(name, TYPES) - distance(name, states))
    expected = (1e4 / (1 + exponent.exp())).unsqueeze(-1).expand(-1, 2)
    torch.testing.assert_close(game.penalty(states, TYPES), expected, rtol=1e-7, atol=1e-12)


def test_penalty_at_the_radius_and_a_metre_outside(game):
    at = game.soft_constraint(torch.tensor([0.0, -1.06], dtype=torch.float64))
    assert at.tolist() == pytest.approx([5000, 49.7], abs=0.1)


def test_a_collision_is_a_distance_of_at_most_the_radius():
    game = make("lane_change").double()
    x = torch.zeros(3, 2, 4, dtype=torch.float64)
    x[:, 1, 0] = torch.tensor([2.499, 2.5, 2.501])
    theta = torch.ones(3, 2, dtype=torch.float64)
    x[1, 1, 0] -= 1e-9
    assert game.violates(x, theta).tolist() == [True, True, False]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_sensors_count_lattice_nodes_inside_the_radius(name, dtype):
    size, least = {"narrow_road": (50, 5), "lane_change": (40, 5), "drone": (30, 0)}[name]
    ones = (2 * TYPES.sum(-1) + TYPES.amin(-1) + least).long()
    assert (int(ones.min()), int(ones.max())) == ((5, 25) if name == "drone" else (10, 30))
    expected = (torch.arange(size) < ones.unsqueeze(-1)).to(dtype)
    sensed = make(name).to(dtype).sensors(TYPES.to(dtype))
    assert torch.equal(sensed, expected.unsqueeze(-2).expand(-1, 2, -1))


def test_sensors_of_a_fractional_type_lie_between_their_neighbours(game):
    low, middle, high = game.sensors(torch.tensor([[2.0, 3.0], [2.0, 3.5], [2.0, 4.0]], dtype=torch.float64)).sum(-1)
    assert (low < middle).all()
    assert (middle < high).all()


def test_terminal_value_is_minus_the_terminal_cost(name, game, states):
    torch.testing.assert_close(game.terminal_value(states), -terminal_cost(name, states), rtol=1e-12, atol=0)


@pytest.mark.parametrize("name", ["narrow_road", "lane_change"])
def test_cars_pay_for_turning_and_accelerating(game):
    u = torch.tensor([[0.5, -3.0], [-0.2, 8.0]], dtype=torch.float64)
    assert game.effort(u).tolist() == pytest.approx([100 * 0.25 + 9, 100 * 0.04 + 64])


@pytest.mark.parametrize("name", ["narrow_road", "lane_change"])
def test_cars_are_unicycles(game, states):
    u = torch.tensor([[0.5, -3.0], [-0.2, 8.0]], dtype=torch.float64).expand(len(states), -1, -1)
    _, _, psi, v = states.unbind(-1)
    expected = torch.stack([v * psi.cos(), v * psi.sin(), u[..., 0], u[..., 1]], -1)
    torch.testing.assert_close(game.dynamics(states, u), expected)


@pytest.mark.parametrize("name", ["narrow_road", "lane_change"])
@pytest.mark.parametrize(
    ("heading_costate", "speed_costate", "expected"),
    [(50.0, 6.0, [0.25, 3.0]), (-300.0, 30.0, [-1.0, 10.0]), (300.0, -20.0, [1.0, -5.0]), (0.0, 0.0, [0.0, 0.0])],
)
def test_cars_clip_the_vertex(game, states, heading_costate, speed_costate, expected):
    costate = torch.randn(len(states), 2, 2, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    costate[:, [0, 1], [0, 1], 2:] = torch.tensor([heading_costate, speed_costate], dtype=torch.float64)
    u = game.optimal_control(states, costate)
    torch.testing.assert_close(u, torch.tensor(expected, dtype=torch.float64).expand_as(u))


@pytest.mark.parametrize("name", ["drone"])
def test_drones_take_roll_pitch_and_thrust(game, states):
    roll, pitch, thrust = 0.03, -0.02, 11.0
    u = torch.tensor([roll, pitch, thrust], dtype=torch.float64).expand(len(states), 2, -1)
    acceleration = torch.tensor([G * math.tan(roll), -G * math.tan(pitch), thrust - G], dtype=torch.float64)
    expected = torch.cat([states[..., 3:], acceleration.expand(len(states), 2, -1)], -1)
    torch.testing.assert_close(game.dynamics(states, u), expected, rtol=1e-7, atol=1e-7)
    effort = 100 * math.tan(roll) ** 2 + 100 * math.tan(pitch) ** 2 + (thrust - G) ** 2
    assert game.effort(u).flatten().tolist() == pytest.approx([effort] * (2 * len(states)), rel=1e-7)


@pytest.mark.parametrize("name", ["drone"])
@pytest.mark.parametrize("own", [[0.3, -0.5, 1.0], [4.0, 4.0, 9.0], [-4.0, -4.0, -9.0], [0.0, 0.0, 0.0]])
def test_drones_clip_the_tangents(game, states, own):
    costate = torch.zeros(len(states), 2, 2, 6, dtype=torch.float64)
    costate[:, [0, 1], [0, 1], 3:] = torch.tensor(own, dtype=torch.float64)
    limit = math.tan(0.05)
    tangents = [min(max(slope, -limit), limit) for slope in (G * own[0] / 200, -G * own[1] / 200)]
    expected = [*map(math.atan, tangents), G + min(max(own[2] / 2, -2), 2)]
    u = game.optimal_control(states, costate)
    torch.testing.assert_close(u, torch.tensor(expected, dtype=torch.float64).expand_as(u), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(
    ("name", "lo", "hi"),
    [
        ("narrow_road", [-1, -5], [1, 10]),
        ("lane_change", [-1, -5], [1, 10]),
        ("drone", [-0.05, -0.05, 7.81], [0.05, 0.05, 11.81]),
    ],
)
def test_control_boxes(game, lo, hi):
    assert game.control_box.lo.tolist() == pytest.approx(lo)
    assert game.control_box.hi.tolist() == pytest.approx(hi)


@pytest.mark.parametrize(
    ("name", "horizon", "nodes"), [("narrow_road", 3.0, 31), ("lane_change", 4.0, 41), ("drone", 4.0, 41)]
)
def test_horizons_and_label_nodes(game, horizon, nodes):
    assert game.horizon == horizon
    assert round(game.horizon / game.label_step) + 1 == nodes
    assert game.type_box.lo.tolist() == [1, 1]
    assert game.type_box.hi.tolist() == [5, 5]


A_DEGREE = math.pi / 180


@pytest.mark.parametrize(
    ("name", "start", "domain"),
    [
        (
            "narrow_road",
            [[(15, 20), (3.25, 4.75), (-A_DEGREE, A_DEGREE), (18, 25)]] * 2,
            [[(15, 95), (0, 8), (-0.2, 0.2), (18, 29)]] * 2,
        ),
        (
            "lane_change",
            [[(0, 3), lane, (-A_DEGREE, A_DEGREE), (18, 25)] for lane in ((1.25, 2.75), (5.25, 6.75))],
            [[(0, 90), (0, 6), (-0.17, 0.15), (17, 26)], [(0, 90), (2, 8), (-0.15, 0.17), (17, 26)]],
        ),
        (
            "drone",
            [[(0, 1), (0, 1), (-0.1, 0.1), (2, 4), (2, 4), (0, 0.1)]] * 2,
            [[(0, 15.5), (0, 15.5), (-2.2, 2.5), (0.3, 4.5), (0.3, 4.5), (-2, 2.2)]] * 2,
        ),
    ],
)
def test_start_boxes_and_domains(game, start, domain):
    for box, limits in ((game.initial_box, start), (game.state_box, domain)):
        expected = torch.tensor(limits, dtype=torch.float64)
        torch.testing.assert_close(torch.stack([box.lo, box.hi], -1), expected, rtol=1e-6, atol=1e-6)


def test_a_drone_is_steered_by_its_own_angles_alone():
    game = make("drone").double()
    u = torch.tensor([[0.0, 0.0, G], [0.0, 0.02, G]], dtype=torch.float64)
    rate = game.dynamics(torch.zeros(2, 6, dtype=torch.float64), u)
    assert rate[0].abs().max() < 1e-6
    assert rate[1, 4].item() == pytest.approx(-G * math.tan(0.02), rel=1e-6)


@pytest.mark.parametrize(
    ("constants", "message"),
    [({"radius": float("nan")}, "finite"), ({"radius": "abc"}, "finite"), ({"horizon": -1.0}, "positive")],
)
def test_impossible_constants_are_refused(constants, message):
    with pytest.raises(ValueError, match=message):
        make("narrow_road", **constants)


def test_an_unknown_constant_names_the_known_ones():
    with pytest.raises(KeyError, match="Did you mean 'radius'"):
        make("narrow_road", raduis=1.0)
