"""`hno new-game` writes a package whose game passes its own test and trains."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from hno.cli.main import main
from tests.cli.test_main import python

Printed = pytest.CaptureFixture[str]


@pytest.mark.slow
@pytest.mark.usefixtures("cache")
def test_the_new_game_passes_its_test_and_trains_once_it_is_installed(tmp_path: Path, capsys: Printed) -> None:
    folder, site = tmp_path / "new", tmp_path / "site"
    assert main(["new-game", "corridor_pass", "--to", str(folder)]) == 0
    assert "pip install -e . --no-deps" in capsys.readouterr().out
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--no-build-isolation"]
    subprocess.run([*pip, "--target", site, folder], check=True, capture_output=True, text=True)
    python("-m", "pytest", "-q", str(folder / "tests"), path=(site,), folder=folder)
    small = ("experiment=smoke", "data.types=1,1", "data.workers=1", "evaluation.dt=0.25", "trainer.max_steps=2")
    commands = [
        ["list", "games"],
        ["train", "game=corridor_pass", "--help"],
        ["train", "game=corridor_pass", *small, "--to", "run"],
    ]
    code = f"from hno.cli.main import main; assert not any([main(words) for words in {commands}])"
    printed = python("-c", code, path=(site,), folder=tmp_path)
    own = "Robots with states", "[hno-corridor-pass 0.1.0]", "* corridor_pass", "two robots that pass each other"
    for part in own:
        assert part in printed
    assert (tmp_path / "run" / "last.ckpt").exists()


def test_nothing_is_overwritten(tmp_path: Path, capsys: Printed) -> None:
    assert main(["new-game", "corridor", "--to", str(tmp_path)]) == 0
    file = tmp_path / "pyproject.toml"
    file.write_text("mine")
    (tmp_path / "hno_corridor" / "__init__.py").unlink()
    capsys.readouterr()
    assert main(["new-game", "corridor", "--to", str(tmp_path)]) == 1
    assert f"Nothing was written: there already: {file}" in capsys.readouterr().err
    assert file.read_text() == "mine"
    assert not (tmp_path / "hno_corridor" / "__init__.py").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "Name the game"),
        (("two", "words"), "Name the game"),
        (("Big",), "small letters"),
        (("a-b",), "small letters"),
        (("class",), "means something else"),
        (("none",), "means something else"),
        (("box",), "means something else"),
        (("drone",), "There is a game 'drone' already"),
    ],
)
def test_names_that_cannot_be_used(
    words: tuple[str, ...], message: str, tmp_path: Path, capsys: Printed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["new-game", *words]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
