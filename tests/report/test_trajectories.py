"""Episodes for other programs hold what was played."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from hno.cli.main import main
from hno.control.rollout import Trajectory
from hno.evaluation.closed_loop import play
from hno.evaluation.episodes import EPISODES, PATHS, episodes, together, write_paths
from hno.games import Game, make
from tests.fakes import evaluation_of, fake_labels


def kept(folder: Path, game: Game) -> Trajectory:
    """A run's folder with the episodes of controls that stay at the middle of their box."""
    label = fake_labels(game, (1.0, 2.0), 3)
    middle = (game.control_box.lo + game.control_box.hi) / 2
    policy = lambda tau, x, theta: middle.expand(len(x), game.players, -1)  # noqa: E731
    evaluation = evaluation_of(game, policy, [label], dt=0.1)
    _, played = next(play(game, evaluation.policy, [label], 0.1))
    found = episodes(evaluation, label, played)
    folder.mkdir(exist_ok=True)
    (folder / EPISODES).write_text(json.dumps(together(game, found)))
    write_paths(found, folder / PATHS)
    results = {"status": "finished", "table": [], "episodes": EPISODES, "paths": PATHS}
    (folder / "results.json").write_text(json.dumps(results))
    return played._replace(x=played.x[found[0].row], u=played.u[found[0].row])


def test_a_table_has_every_step_of_every_player(tmp_path: Path) -> None:
    played = kept(tmp_path, make("narrow_road"))
    assert main(["episodes", str(tmp_path), "--to", "csv", f"folder={tmp_path}/out"]) == 0
    with (tmp_path / "out" / "episodes.csv").open(newline="") as file:
        rows = [
            row for row in csv.DictReader(file) if (row["episode"], row["of"], row["player"]) == ("0", "policy", "2")
        ]
    assert len(rows) == len(played.t)
    states = [[float(row[f"state {name}"]) for name in ("px [m]", "py [m]", "psi [rad]", "v [m/s]")] for row in rows]
    np.testing.assert_allclose(states, played.x[:, 1], rtol=1e-4, atol=1e-4)
    across = [float(row["x [m]"]) for row in rows]
    np.testing.assert_allclose(across, 70 - played.x[:, 1, 0], rtol=1e-4, atol=1e-4)
    turns = [float(row["control turn rate [rad/s]"]) for row in rows][:-1]
    np.testing.assert_allclose(turns, played.u[:, 1, 0], atol=1e-5)


def test_a_scenario_has_cars_of_the_scene_on_its_lanes(tmp_path: Path) -> None:
    game = make("lane_change")
    played = kept(tmp_path, game)
    assert main(["episodes", str(tmp_path), "--to", "commonroad"]) == 0
    root = ET.parse(tmp_path / "episodes" / "episode_0.xml").getroot()
    assert (root.tag, root.get("commonRoadVersion"), float(root.get("timeStepSize", 0))) == ("commonRoad", "2020a", 0.1)
    lanes = [[float(y.text or "nan") for y in lane.iter("y")] for lane in root.iter("lanelet")]
    assert lanes == [[8, 8, 4, 4], [4, 4, 0, 0]]
    first, second = root.iter("dynamicObstacle")
    assert [float(first.findtext(f".//rectangle/{side}", "nan")) for side in ("length", "width")] == [4.5, 1.8]
    for player, car in enumerate((first, second)):
        places = [[float(point.findtext(axis, "nan")) for axis in "xy"] for point in car.iter("point")]
        np.testing.assert_allclose(places, game.positions(played.x)[:, player], atol=1e-4)
        assert [int(time.text or -1) for time in car.findall(".//time/exact")] == list(range(len(played.t)))


@pytest.mark.parametrize("kind", ["commonroad", "mcap"])
def test_numbers_that_are_not_finite_are_refused_by_formats_without_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    if kind == "mcap":
        pytest.importorskip("mcap", reason="needs the package mcap")
    kept(tmp_path, make("lane_change"))
    arrays = load_file(tmp_path / PATHS)
    arrays["0.x"][-1] = np.nan
    save_file(arrays, tmp_path / PATHS)
    assert main(["episodes", str(tmp_path), "--to", kind]) == 1
    assert "Episode 0 has numbers that are not finite. Choose csv" in capsys.readouterr().err
    assert not (tmp_path / "episodes").exists()
    assert main(["episodes", str(tmp_path), "--to", "csv"]) == 0


def test_drones_are_no_cars(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kept(tmp_path, make("drone"))
    assert main(["episodes", str(tmp_path), "--to", "commonroad"]) == 1
    assert "CommonRoad is for cars" in capsys.readouterr().err


def test_a_log_has_a_topic_for_every_player(tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap.reader", reason="needs the package mcap")
    played = kept(tmp_path, make("drone"))
    assert main(["episodes", str(tmp_path), "--to", "mcap"]) == 0
    with (tmp_path / "episodes" / "episode_0.mcap").open("rb") as file:
        messages = [(topic.topic, json.loads(one.data)) for _, topic, one in reader.make_reader(file).iter_messages()]
    own = [content for topic, content in messages if topic == "/policy/player_1"]
    assert torch.tensor([one["states"]["pz [m]"] for one in own]).sub(played.x[:, 0, 2]).abs().max() < 1e-5


def test_without_the_package_one_line_says_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    kept(tmp_path, make("drone"))
    monkeypatch.setitem(__import__("sys").modules, "mcap.writer", None)
    monkeypatch.setitem(__import__("sys").modules, "mcap", None)
    assert main(["episodes", str(tmp_path), "--to", "mcap"]) == 1
    assert "pip install mcap" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "Name one run and one format"),
        (["RUN", "--to", "rosbag"], "rosbag"),
        (["nowhere", "--to", "csv"], "nowhere is not a folder"),
        (["RUN", "--to", "csv"], "names no file of them"),
    ],
)
def test_what_cannot_be_written_is_refused(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "results.json").write_text('{"episodes": "episodes.json"}')
    assert main(["episodes", *(str(tmp_path) if word == "RUN" else word for word in words)]) in (1, 2)
    assert message in capsys.readouterr().err
