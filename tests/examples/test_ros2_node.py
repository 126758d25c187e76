"""The ROS 2 node under a stand-in for rclpy: it plays as hno.rollout does, and keeps silent where it must."""

from __future__ import annotations

import importlib.util
import math
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

import hno
from hno.pontryagin.integrate import runge_kutta
from hno.runtime import ArtefactError
from tests.examples.conftest import FOLDER
from tests.examples.ros import World

PACKAGE = FOLDER / "ros2_node"
CASE = "narrow_road potential sin 1"
START = [[16.0, 4.2, 0.01, 20.0], [18.0, 3.7, -0.01, 22.0]]
DT = 0.05


class Robots:
    """Nodes in a world, and what they drive.

    Args:
        world: where they are.
        module: the node's.
        artefact: folder of the controller, by kind.
    """

    def __init__(self, world: World, module: ModuleType, artefact: Callable[[str], Path]) -> None:
        self.world, self.module, self.artefact = world, module, artefact

    def node(self, kind: str = "numpy", **changed: object) -> object:
        given = {"artefact": str(self.artefact(kind)), "game": "narrow_road", "theta": "2,4", "rate": 1 / DT}
        self.world.parameters = given | changed
        return self.module.Controller()

    def tell(self, x: object = START, age: float = 0.0) -> None:
        for player, state in enumerate(np.asarray(x, float), start=1):
            self.world.publish(f"player_{player}/state", self.world.now - age, *state)

    def controls(self, player: int = 1) -> list[list[float]]:
        return self.world.published.get(f"player_{player}/control", [])

    def warnings(self) -> list[str]:
        return [text for kind, text in self.world.logged if kind == "warning"]


@pytest.fixture
def robots(exported: Callable[[str, str], Path], monkeypatch: pytest.MonkeyPatch) -> Robots:
    world = World()
    for name, module in world.modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("hno_ros_node", PACKAGE / "hno_controller" / "node.py")
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return Robots(world, module, lambda kind: exported(CASE, kind))


def test_two_nodes_of_two_kinds_play_as_a_rollout_does(robots: Robots) -> None:
    """Player 1 runs the NumPy controller and player 2 the one in C; the cars are the game's."""
    policy = hno.load_exported(robots.artefact("numpy"))
    game, x = policy.game, torch.tensor([START])
    played = hno.rollout(game, policy, x, (2.0, 4.0), dt=DT)
    robots.node("numpy", player=1), robots.node("c", player=2)
    robots.world.advance(DT / 2)
    robots.world.publish("start", robots.world.now + DT / 2)
    for k in range(60):
        robots.tell(x[0], age=-DT / 2)  # as of the tick, which comes half a step later
        robots.world.advance(DT)
        u = torch.tensor([[robots.controls(player)[-1][1:] for player in (1, 2)]])
        np.testing.assert_allclose(u[0], played.u[0, k], atol=2e-3)
        for _ in range(4):
            x = runge_kutta(game, x, u, DT / 4)
    np.testing.assert_allclose(x, played.x[:, -1], atol=1e-2)
    assert [len(robots.controls(player)) for player in (1, 2)] == [60, 60]
    robots.tell(x[0])
    robots.world.advance(2 * DT)
    assert len(robots.controls()) == 61  # the one at the horizon; then the game is over
    assert "the game lasts 3 s" in robots.warnings()[-1]


def started(robots: Robots, **changed: object) -> Robots:
    """A node that plays."""
    robots.node(**changed)
    robots.world.publish("start", robots.world.now)
    robots.tell()
    robots.world.advance(DT)
    assert len(robots.controls()) == 1
    assert robots.world.logged[-1] == ("info", "controls are published")
    return robots


BAD = {
    "stale": ([*START[0]], 1.0, "not of the last 0.1 s"),
    "from the future": ([*START[0]], -1.0, "not of the last 0.1 s"),
    "NaN": ([16.0, math.nan, 0.0, 20.0], 0.0, "the state is not finite"),
    "infinite": ([16.0, math.inf, 0.0, 20.0], 0.0, "the state is not finite"),
    "short": ([16.0, 4.0, 0.0], 0.0, "expected a time and 4 states, got 4 numbers"),
    "long": ([*START[0], 1.0], 0.0, "expected a time and 4 states, got 6 numbers"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_state_that_makes_no_sense_stops_the_controls_until_a_sound_one_comes(robots: Robots, name: str) -> None:
    state, age, said = BAD[name]
    started(robots)
    robots.tell()
    robots.world.publish("player_1/state", robots.world.now - age, *state)
    robots.world.advance(DT)
    robots.world.advance(DT)
    assert len(robots.controls()) == len(robots.controls(2)) == 1
    assert [text for text in robots.warnings() if said in text] == [robots.warnings()[-1]]  # said once
    assert "player 1" in robots.warnings()[-1]
    robots.tell()
    robots.world.advance(DT)
    assert len(robots.controls()) == 2


def test_a_player_that_falls_silent_stops_the_controls(robots: Robots) -> None:
    started(robots)
    for _ in range(4):
        robots.world.publish("player_1/state", robots.world.now, *START[0])
        robots.world.advance(DT)
    assert 1 <= len(robots.controls()) <= 3
    assert "player 2: the state is not of the last" in robots.warnings()[-1]


@pytest.mark.parametrize("begin", [None, (math.nan,), (1e9,), (1.7e9 + 1,), (), (1.7e9, 1.0)])
def test_outside_the_horizon_nothing_is_published(robots: Robots, begin: tuple[float, ...] | None) -> None:
    robots.node()
    if begin is not None:
        robots.world.publish("start", *begin)
    robots.tell()
    robots.world.advance(DT)
    assert robots.controls() == []
    assert len(robots.warnings()) == 1


def test_a_fallback_that_is_named_is_published_instead(robots: Robots) -> None:
    robots.node(fallback="0,-5")
    robots.world.advance(DT)
    assert robots.controls() == [[robots.world.now, 0.0, -5.0]] == robots.controls(2)
    assert "the fallback is published" in robots.warnings()[-1]


def test_states_outside_the_box_are_answered_with_a_warning(robots: Robots) -> None:
    started(robots)
    robots.tell([[14.0, *START[0][1:]], START[1]])
    robots.world.advance(DT)
    assert len(robots.controls()) == 2
    assert "outside the box where it was learned" in robots.warnings()[-1]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"game": "lane_change"}, "controller of 'narrow_road', and the parameter game is 'lane_change'"),
        ({"game": ""}, "artefact .* and game .* are needed"),
        ({"artefact": "nowhere"}, "no exported controller"),
        ({"theta": "1"}, "theta must be 2 finite numbers"),
        ({"theta": "1,nan"}, "theta must be 2 finite numbers"),
        ({"theta": "one,two"}, "theta must be 2 finite numbers"),
        ({"player": 3}, "player must be 1 to 2, or 0"),
        ({"player": -1}, "player must be 1 to 2, or 0"),
        ({"rate": 0.0}, "rate must be a positive number"),
        ({"stale": math.nan}, "stale must be a positive number"),
        ({"fallback": "0,-6"}, "fallback must lie in the control box"),
        ({"fallback": "0"}, "fallback must be 2 finite numbers"),
    ],
)
def test_what_makes_no_sense_ends_the_node_before_it_listens(
    robots: Robots, changed: dict[str, object], said: str
) -> None:
    with pytest.raises((ArtefactError, ValueError), match=said):
        robots.node(**changed)
    assert not robots.world.timers
    assert not robots.world.published
    with pytest.raises(SystemExit, match=said):
        robots.module.main()


def test_a_damaged_controller_is_refused(robots: Robots, tmp_path: Path) -> None:
    for file in robots.artefact("numpy").iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes() + b" " * (file.suffix == ".py"))
    with pytest.raises(ArtefactError, match="damaged"):
        robots.node(artefact=str(tmp_path))


def test_a_type_outside_the_box_is_warned_of(robots: Robots) -> None:
    robots.node(theta="0.5,6")
    assert "theta lies outside the types" in robots.warnings()[0]


def test_the_package_names_what_it_installs() -> None:
    text = (PACKAGE / "setup.py").read_text()
    assert ElementTree.parse(PACKAGE / "package.xml").findtext("name") == "hno_controller"
    assert 'NAME = "hno_controller"' in text
    for name in ("package.xml", "launch/players.launch.py", "resource/hno_controller", "hno_controller/node.py"):
        assert (PACKAGE / name).exists()
