"""`hno simulate`: what it plays is a rollout of the exported controllers, and its page is nobody else's."""

from __future__ import annotations

import http.client
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

import hno
from hno.cli.main import main
from hno.cli.simulate import SimulateSettings, about, choose, play, steered
from hno.cli.window import Over, Window
from hno.control.rollout import rollout
from hno.export import export
from hno.operators import Architecture, Choice, make_operator
from tests.report.test_browser import ARGUMENTS, CHROMIUM

SMALL = Choice("value"), Choice("deeponet", {"width": 6, "depth": 2}), Choice("tanh")


def small(game: str, folder: Path, seed: int = 0) -> str:
    torch.manual_seed(seed)
    operator = make_operator(hno.games.make(game), Architecture(*SMALL))
    operator.value_scale.fill_(400.0)
    return str(export(operator.eval().requires_grad_(False), "numpy", folder))


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory) -> str:
    return small("narrow_road", tmp_path_factory.mktemp("one") / "a<script>")


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> str:
    return small("narrow_road", tmp_path_factory.mktemp("two") / "b", 1)


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> str:
    return small("intersection", tmp_path_factory.mktemp("other") / "c")


def printed(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert main(["simulate", *words, "--no-window"]) == 0
    return capsys.readouterr().out


def test_each_player_plays_its_own_part_of_its_own_controller(one, two, capsys) -> None:
    """As a rollout of a policy that is put together by hand says; other controllers, seeds and types say otherwise."""
    first, second = hno.load_exported(one), hno.load_exported(two)

    def both(tau, x, theta):
        return torch.stack([first(tau, x, theta)[:, 0], second(tau, x, theta)[:, 1]], 1)

    found = printed(capsys, one, two, "theta=2,4", "seed=3")
    chosen = choose([one, two], SimulateSettings(theta="2,4", seed=3))
    played = rollout(first.game, both, chosen.start(), (2.0, 4.0))
    values = ", ".join(f"{value:.4g}" for value in played.value[0].tolist())
    assert f"closest {float(played.distance):.3f} m, clearance {float(played.clearance):.3f} m" in found
    assert f"values {values}\n" in found
    assert ("COLLISION" in found) == bool(played.collided)
    others = [(two, one, "theta=2,4", "seed=3"), (one, "theta=2,4", "seed=3"), (one, two, "theta=2,4")]
    assert len({found, *(printed(capsys, *words) for words in others)}) == 4


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "Name one exported controller"),
        (["theta=1"], "theta must be 2 finite numbers"),
        (["theta=1,nan"], "theta must be 2 finite numbers"),
        (["sped=1"], "sped does not exist"),
        (["~theta"], "~theta does not exist"),
        (["speed=0"], "speed must be greater than or equal to 0.05"),
        (["speed=nan"], "speed must be a finite number"),
        (["seed=1.5"], "seed must be a valid integer"),
        (["drive=1"], "names no player who can be driven here"),
        (["port=70000"], "port must be less than"),
        (["dt=0.7"], "dt must be a positive time that divides the horizon"),
    ],
)
def test_words_that_make_no_sense_are_refused_before_any_work(one, words, said, capsys) -> None:
    assert main(["simulate", *([one] if words else []), *words, "--no-window"]) == 2
    assert said in capsys.readouterr().err


def test_controllers_that_do_not_fit_are_refused(one, two, other, tmp_path, capsys) -> None:
    assert main(["simulate", one, other, "--no-window"]) == 2
    assert "of different games" in capsys.readouterr().err
    assert main(["simulate", one, two, one, "--no-window"]) == 2
    assert "or one for each; got 3" in capsys.readouterr().err
    assert main(["simulate", str(tmp_path), "--no-window"]) == 1
    assert "is no exported controller" in capsys.readouterr().err
    assert main(["simulate", one, "drive=3"]) == 2
    assert "drive=3 names no player" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["narrow_road", "intersection", "drone"])
def test_a_person_reaches_the_ends_of_the_control_box_and_no_further(name: str) -> None:
    game = hno.games.make(name)
    lo, hi = game.control_box.lo, game.control_box.hi
    torch.testing.assert_close(steered(game, 0, [1.0] * game.control_dim), hi)
    torch.testing.assert_close(steered(game, 1, [-1.0] * game.control_dim), lo)
    rest = steered(game, 0, [])
    assert bool(((lo <= rest) & (rest <= hi)).all())
    assert bool(((rest == 0) | (lo > 0) | (hi < 0)).all())


class Playing:
    """Episodes in a window, in a thread of their own."""

    def __init__(self, paths: list[str], **settings: Any) -> None:
        self.chosen = choose(paths, SimulateSettings(seed=3, dt=0.1))
        self.window = Window(0, about(self.chosen.game, paths), **settings)
        self.thread = threading.Thread(target=self.run, daemon=True)

    def run(self) -> None:
        while True:
            play(self.chosen, self.window)

    def __enter__(self) -> Playing:
        self.window.__enter__()
        self.thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.window.__exit__(*error)

    def request(self, method: str, path: str, body: str | None = None, **headers: str) -> http.client.HTTPResponse:
        connection = http.client.HTTPConnection("127.0.0.1", self.window.server.server_port, timeout=30)
        connection.request(method, path, body, headers)
        return connection.getresponse()

    def events(self) -> Iterator[dict[str, Any]]:
        answer = self.request("GET", f"/events?token={self.window.token}")
        assert answer.status == 200
        for line in answer:
            if line.startswith(b"data: "):
                yield json.loads(line.removeprefix(b"data: "))

    def ask(self, **content: Any) -> int:
        return self.request("POST", f"/ask?token={self.window.token}", json.dumps(content)).status


@pytest.fixture
def playing(one) -> Iterator[Playing]:
    with Playing([one], speed=10.0) as found:
        yield found


def episode(events: Iterator[dict[str, Any]]) -> list[dict[str, Any]]:
    found = [next(events)]
    while "end" not in found[-1]:
        found.append(next(events))
    return found


def test_the_page_hears_of_every_step(playing: Playing) -> None:
    first, *frames, last = episode(playing.events())
    chosen, policy = playing.chosen, playing.chosen.policies[0]
    played = rollout(chosen.game, policy, chosen.start(), [chosen.theta], dt=0.1)
    assert first["about"]["players"] == 2
    assert [frame["t"] for frame in frames] == pytest.approx(played.t[:-1].tolist())
    for k, frame in enumerate(frames):
        x, theta = played.x[0, k], torch.tensor(chosen.theta)
        torch.testing.assert_close(torch.tensor(frame["places"]), chosen.game.positions(x), atol=1e-3, rtol=0)
        torch.testing.assert_close(torch.tensor(frame["controls"]), played.u[0, k], atol=1e-3, rtol=0)
        value = policy.value(chosen.game.horizon - frame["t"], x, theta)
        torch.testing.assert_close(torch.tensor(frame["values"]), value.float(), atol=1e-2, rtol=1e-3)
        assert frame["distance"] - frame["radius"] == pytest.approx(
            -float(chosen.game.constraint(x, theta).max()), abs=1e-3
        )
    assert "seed 3" in last["end"]
    assert last["bad"] == bool(played.collided)


def test_a_person_drives_one_player_until_the_page_is_closed(one) -> None:
    with Playing([one], player=2, speed=10.0) as playing:
        playing.window.ask({"paused": True})
        events = playing.events()
        next(events), next(events)
        assert playing.ask(drive=[1, -1], paused=False) == 204
        frames = episode(events)[:-1]
        assert all(frame["controls"][1] == [1.0, -5.0] for frame in frames)
        assert any(frame["controls"][0] != [1.0, -5.0] for frame in frames)
        assert playing.ask(again=True) == 204
        assert "title" in next(events)
        events.close()
        deadline = time.monotonic() + 30
        while playing.window.asked.drive:
            assert time.monotonic() < deadline
            time.sleep(0.05)


def test_controls_that_are_not_finite_end_the_episode(playing: Playing) -> None:
    policy = playing.chosen.policies[0]
    sound = policy.answers

    def answers(at):
        found = sound(at)
        return found if float(at.tau) > 2.0 else {**found, "control": found["control"] * torch.nan}

    policy.answers = answers
    *_, frame, last = episode(playing.events())
    assert frame["t"] == pytest.approx(1.0)
    assert frame["controls"] == [[None, None]] * 2
    assert "no controller has a finite answer" in last["end"]
    assert last["bad"]


BAD = [
    {"drive": [2, 0]},
    {"drive": [0]},
    {"drive": [float("nan"), 0]},
    {"player": 3},
    {"speed": 0},
    {"other": 1},
    {"paused": "x"},
]


def test_what_makes_no_sense_changes_nothing(playing: Playing) -> None:
    before = playing.window.asked
    assert [playing.ask(**content) for content in BAD] == [400] * len(BAD)
    address = f"/ask?token={playing.window.token}"
    for body in ("", "[1]", "null", "{", "[" * 3000, "{}" + " " * 5000):
        assert playing.request("POST", address, body).status == 400
    assert playing.window.asked == before


def test_only_the_page_itself_is_answered(playing: Playing) -> None:
    """Neither without the token, nor by another name of this machine, nor from another site."""
    token, port = playing.window.token, playing.window.server.server_port
    for path in ("/", "/events", "/?token=", "/events?token=wrong", "/?token=%C3%A9"):
        assert playing.request("GET", path).status == 403
    for headers in ({"Host": f"evil.example:{port}"}, {"Origin": "http://evil.example"}, {"Origin": "null"}):
        assert playing.request("GET", f"/?token={token}", **headers).status == 403
        assert playing.request("POST", f"/ask?token={token}", '{"paused": true}', **headers).status == 403
    assert playing.request("GET", f"/other?token={token}").status == 404
    assert not playing.window.asked.paused
    assert playing.window.server.server_address[0] == "127.0.0.1"
    page = playing.request("GET", f"/?token={token}", Origin=f"http://localhost:{port}")
    policy, text = page.headers["Content-Security-Policy"], page.read().decode()
    assert "default-src 'none'" in policy
    (nonce,) = set(re.findall(r"'nonce-([^']+)'", policy))
    assert set(re.findall(r'nonce="([^"]+)"', text)) == {nonce}
    assert not re.findall(r"https?://", text)


def test_a_port_that_is_taken_is_one_line(one, capsys) -> None:
    with Window(0, {"players": 2, "controls": [[[0]]]}) as taken:
        assert main(["simulate", one, f"port={taken.server.server_port}"]) == 1
    assert "cannot be used" in capsys.readouterr().err


def test_the_next_episode_ends_this_one() -> None:
    window = Window(0, {"players": 1, "controls": [[[0.0]], [[1.0]]]})
    window.ask({"again": True})
    with pytest.raises(Over):
        window.pace(1000.0)
    window.server.server_close()


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_a_signal_ends_it_with_one_line(one, number: int) -> None:
    """While it waits for somebody to open the page."""
    command = [sys.executable, "-m", "hno", "simulate", one]
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as running:
        assert running.stdout is not None
        assert running.stdout.readline().startswith("http://127.0.0.1:")
        running.send_signal(number)
        out, err = running.communicate(timeout=60)
    assert running.returncode == 128 + number
    assert (out, err) == ("", f"Interrupted by {signal.Signals(number).name}.\n")


@pytest.mark.skipif(CHROMIUM is None, reason="needs Debian's package chromium")
def test_the_page_in_a_browser(one, tmp_path) -> None:
    """Everything is drawn, keys drive, names of files are text, nothing is asked of anybody else, nothing is said."""
    playwright = pytest.importorskip("playwright.sync_api", reason="needs the package playwright")
    with Playing([one], player=1, speed=0.05) as playing, playwright.sync_playwright() as started:
        context = started.chromium.launch_persistent_context(
            tmp_path, executable_path=shutil.which("chromium"), args=list(ARGUMENTS), headless=True
        )
        context.set_default_timeout(60_000)
        page, said, asked = context.new_page(), list[str](), list[str]()
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(playing.window.address)
        playwright.expect(page.locator("#artefacts")).to_contain_text("a<script>")
        assert page.locator("canvas:visible").count() == 5  # from above, distance, two controls, values
        page.keyboard.down("ArrowUp")
        page.keyboard.down("ArrowLeft")
        until(lambda: playing.window.asked.drive == [1, 1])
        until(lambda: playing.window.events[-1].get("controls", [0])[0] == [1.0, 10.0])
        page.keyboard.up("ArrowUp")
        until(lambda: playing.window.asked.drive == [1, 0])
        page.keyboard.press("p")
        until(lambda: playing.window.asked.paused)
        inked = """id => { const found = document.getElementById(id), pen = found.getContext("2d")
            return pen.getImageData(0, 0, found.width, found.height).data.some(entry => entry) }"""
        assert all(page.evaluate(inked, name) for name in ("top", "distance", "control1", "control2", "values"))
        page.select_option("#player", "0")
        until(lambda: playing.window.asked.player == 0)
        page.select_option("#speed", "2")
        page.click("#pause")
        playwright.expect(page.locator("#state")).to_contain_text("clearance")
        events = playing.window.events
        page.click("#again")
        until(lambda: playing.window.events is not events)
        context.close()
    assert said == []
    assert {url.split("/")[2] for url in asked if not url.startswith("data:")} == {playing.window.address.split("/")[2]}


def until(condition, seconds: float = 60) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)
