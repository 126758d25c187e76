"""The loop in C drives as hno.rollout does and says what it refuses; deadlines are the machine's, and not tested."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

import hno
from hno.pontryagin.integrate import runge_kutta
from tests.examples.conftest import FOLDER

SOURCE = FOLDER / "realtime" / "loop.c"
CASE = "narrow_road potential sin 1"
START = [[16.0, 4.2, 0.01, 20.0], [18.0, 3.7, -0.01, 22.0]]
THETA = (2.0, 4.0)
WORDS = ["rate=100", "fast=1", "theta=2,4", "start=" + ",".join(str(entry) for player in START for entry in player)]


def build(folder: Path, to: Path) -> Path:
    flags = ["-std=c99", "-pedantic", "-O2", "-Wall", "-Wextra", "-Werror", f"-I{folder}"]
    sources = [str(SOURCE), str(folder / "hno_controller.c"), "-lm"]
    subprocess.run(["gcc", *flags, *sources, "-o", str(to)], check=True)
    return to


def run(program: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([program, *words], capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def program(exported: Callable[[str, str], Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(exported(CASE, "c"), tmp_path_factory.mktemp("loop") / "loop")


def test_the_loop_drives_as_a_rollout_does(program: Path, exported: Callable[[str, str], Path], tmp_path: Path) -> None:
    trace = tmp_path / "trace.txt"
    ended = run(program, *WORDS, f"trace={trace}")
    assert ended.returncode == 0, ended.stderr
    policy = hno.load_exported(exported(CASE, "c"))
    played = hno.rollout(policy.game, policy, torch.tensor([START], dtype=torch.float64), THETA, dt=0.01)
    rows = np.loadtxt(trace)
    np.testing.assert_allclose(rows[:, 0], played.t[:-1], atol=1e-6)
    np.testing.assert_allclose(rows[:, 1:9], played.x[0, :-1].flatten(1), atol=1e-3)
    np.testing.assert_allclose(rows[:, 9:], played.u[0].flatten(1), atol=1e-2)
    said = re.search(r"distance: (\S+) m, collision below (\S+) m: (\d) of 1 episodes collided", ended.stdout)
    assert said is not None
    assert float(said[1]) == pytest.approx(float(played.distance), abs=5e-2)  # a rollout looks between steps too
    assert float(said[2]) == pytest.approx(float(policy.game.collision_radius(torch.tensor([THETA]))[0, 0, 0]))
    assert int(said[3]) == int(played.collided)


def test_cars_drive_on_with_what_they_have_where_deadlines_are_missed(program: Path, tmp_path: Path) -> None:
    """In real time, whatever the machine makes of it: no period is left out, and none has controls from nowhere."""
    trace = tmp_path / "trace.txt"
    ended = run(program, "rate=2000", f"trace={trace}")
    missed = re.search(r"missed deadlines: (\d+) ", ended.stdout)
    assert missed is not None
    rows = torch.from_numpy(np.loadtxt(trace))
    x, u = rows[:, 1:9].unflatten(1, (2, 4)), rows[:, 9:].unflatten(1, (2, 2))
    assert len(rows) == 6000
    after = runge_kutta(hno.games.make("narrow_road").double(), x[:-1], u[:-1], 1 / 2000)
    torch.testing.assert_close(x[1:], after, atol=1e-6, rtol=0)
    held = (u[1:] == u[:-1]).all(-1).all(-1)
    assert int(held.sum()) + bool((u[0] == 0).all()) >= int(missed[1])


def test_the_game_that_the_loop_knows_is_the_narrow_road() -> None:
    assert f'"{hno.games.make("narrow_road").fingerprint()}"' in SOURCE.read_text()


def test_a_controller_of_another_game_is_refused(exported: Callable[[str, str], Path], tmp_path: Path) -> None:
    """The lane change has as many players, states and controls."""
    folder = tmp_path / "other"
    folder.mkdir()
    known, other = (hno.games.make(game).fingerprint() for game in ("narrow_road", "lane_change"))
    for name in ("hno_controller.c", "hno_controller.h"):
        text = (exported(CASE, "c") / name).read_text()
        (folder / name).write_text(text.replace(known, other))
    ended = run(build(folder, tmp_path / "loop"), *WORDS)
    assert ended.returncode == 1
    assert "of another game" in ended.stderr
    assert ended.stdout == ""


@pytest.mark.parametrize(
    "word", ["rate=0", "rate=2.5", "rate=1e9", "theta=1", "theta=nan,1", "start=1,2,3", "theta=1,1,1", "other=1", "500"]
)
def test_words_that_make_no_sense_are_refused(program: Path, word: str) -> None:
    ended = run(program, "fast=1", word)
    assert ended.returncode == 2
    assert word in ended.stderr
    assert ended.stdout == ""


def test_the_loop_allocates_nothing() -> None:
    assert not re.search(r"\b(malloc|calloc|realloc|alloca)\b", SOURCE.read_text())
