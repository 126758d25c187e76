"""`hno list` and `hno check-game`."""

from __future__ import annotations

from pathlib import Path

import pytest

from hno.cli.confs import groups
from hno.cli.listing import KINDS
from hno.cli.main import main
from hno.games import games
from hno.registry import plural
from tests.walkers import Walkers

Printed = pytest.CaptureFixture[str]


def test_every_kind_is_listed_with_a_line_for_each_name(capsys: Printed) -> None:
    assert main(["list"]) == 0
    printed = capsys.readouterr().out
    for name in ("drone", "hno", "potential", "deeponet", "sin", "residual", "band", "soap"):
        line, *_ = [line for line in printed.splitlines() if line.startswith(f"  {name} ")]
        assert line.endswith("]")
        assert len(line.split()) > 3, "every name has a summary"
    heads = [line.split(" (")[0] for line in printed.splitlines() if line and not line.startswith(" ")]
    assert heads[: len(KINDS)] == list(map(plural, KINDS))
    assert {"data", "experiment", "trainer"} <= set(heads)
    assert not set(groups("train")) - {*heads, *KINDS, "operator", "callbacks"}, "every group of choices is listed"


def test_some_kinds_in_the_singular_or_the_plural(capsys: Printed) -> None:
    assert main(["list", "losses", "game"]) == 0
    printed = capsys.readouterr().out
    assert [line.split()[0] for line in printed.splitlines() if line and not line.startswith(" ")] == [
        "losses",
        "games",
    ]
    assert main(["list", "loses"]) == 2
    assert "Did you mean 'loss'?" in capsys.readouterr().err


def test_what_cannot_be_loaded_is_named(capsys: Printed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(games.broken, "hno.games.mine", "SyntaxError: invalid syntax (mine.py)")
    assert main(["list", "games"]) == 1
    found = capsys.readouterr()
    assert "narrow_road" in found.out
    assert "Could not be loaded: hno.games.mine: SyntaxError: invalid syntax (mine.py)" in found.err


def test_a_game_is_told_whether_it_has_a_potential(capsys: Printed) -> None:
    assert main(["check-game", "narrow_road"]) == 0
    assert "It is a potential game: function=potential" in capsys.readouterr().out
    assert main(["check-game", "tests.walkers:Walkers"]) == 0
    assert "does not say so. With `potential = True`" in capsys.readouterr().out


def test_a_registered_game_is_checked(capsys: Printed) -> None:
    assert main(["check-game", "narrow_road", "game.constants.radius=1.5"]) == 0
    assert "narrow_road keeps the contract of a game: 2 players" in capsys.readouterr().out
    assert main(["check-game", "narow_road"]) == 1
    assert "Did you mean 'narrow_road'?" in capsys.readouterr().err
    assert main(["check-game", "narrow_road", "game.constants.radios=1.5"]) == 1
    assert "Did you mean 'radius'?" in capsys.readouterr().err
    assert main(["check-game", "narrow_road", "radius=1.5"]) == 2
    assert "game.constants.<name>=<value>" in capsys.readouterr().err


def test_a_class_of_a_file_is_checked(capsys: Printed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_game.py").write_text("from tests.walkers import Walkers\nx = 1\n")
    monkeypatch.chdir(tmp_path)
    assert main(["check-game", "own_game:Walkers"]) == 0
    assert main(["check-game", "own_game:x"]) == 1
    assert "own_game has no class 'x' that is a Game" in capsys.readouterr().err
    assert main(["check-game", "nothing_of_that_name:X"]) == 1
    assert "No module named 'nothing_of_that_name'" in capsys.readouterr().err


def test_a_broken_game_is_refused_in_plain_words(capsys: Printed, monkeypatch: pytest.MonkeyPatch) -> None:
    class Slow(Walkers):
        def __init__(self) -> None:
            super().__init__()
            self.label_step = 0.7

    monkeypatch.setattr(games, "_classes", {**games._classes, "slow": Slow})
    assert main(["check-game", "slow"]) == 1
    printed = capsys.readouterr().err
    assert "slow cannot be used yet: Expected a horizon that is a whole multiple of label_step" in printed
    assert "Traceback" not in printed


def test_a_file_that_cannot_be_read_is_one_sentence(tmp_path, capsys, monkeypatch):
    (tmp_path / "unfinished.py").write_text("class Unfinished(")
    monkeypatch.chdir(tmp_path)
    assert main(["check-game", "unfinished:Unfinished"]) == 1
    said = capsys.readouterr().err
    assert "cannot be used yet: SyntaxError" in said
    assert "Traceback" not in said
