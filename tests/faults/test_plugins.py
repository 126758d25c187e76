"""Plugins that cannot be loaded."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from hno.cli.main import main

ROOT = Path(__file__).parents[2]
BROKEN = {
    "importing": ("broken:Game", "import nothing_there", "ModuleNotFoundError"),
    "syntax": ("broken:Game", "class Game(", "SyntaxError"),
    "exiting": ("broken:Game", "raise SystemExit(3)", "SystemExit: 3"),
    "number": ("broken:Game", "Game = 3", "must be a class or a function that builds one; got 3"),
    "kind": ("broken:Game", "class Game: pass", "must extend hno.games.base.Game"),
    "unnamed": ("broken:Gmae", "class Game: pass", "no attribute 'Gmae'"),
    "malformed": ("not a module", "", "AttributeError"),
    "taken": ("broken:Mine", "from tests.walkers import Walkers as Mine", "'narrow_road' is taken by hno.games."),
}
CHOSEN = ["importing", "kind"]


def test_broken_plugins_are_named_with_the_reason_and_stop_nothing(tmp_path: Path) -> None:
    paths = []
    for name, (place, source, _) in BROKEN.items():
        folder = tmp_path / name
        (info := folder / f"{name}-1.0.dist-info").mkdir(parents=True)
        (folder / f"broken_{name}.py").write_text(source)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        place = place.replace("broken", f"broken_{name}")
        also = "narrow_road = broken_kind:Game\n" if name == "kind" else ""
        offered = "narrow_road" if name == "taken" else name
        (info / "entry_points.txt").write_text(f"[hno.games]\n{offered} = {place}\n{also}")
        paths.append(str(folder))
    code = (
        "from hno.cli.main import main\n"
        "print(main(['list', 'games']), main(['train', '--help']), main(['train', 'experiment=smoke', '--dry-run']))\n"
        f"for name in {CHOSEN!r}: print(name, main(['train', 'experiment=smoke', '--dry-run', f'game={{name}}']))"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([*paths, str(ROOT)])}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert "1 0 0" in done.stdout.splitlines()
    said = done.stderr.splitlines()
    for name, (_, _, why) in BROKEN.items():
        assert [
            line
            for line in said
            if line.startswith("Could not be loaded") and f" of {name} 1.0" in line and why in line
        ]
    for name in CHOSEN:
        assert f"{name} 2" in done.stdout.splitlines()
        assert [line for line in said if line.startswith(f"No game named '{name}'.") and "Could not be loaded" in line]


HEAD = "import torch\nfrom tests.games.test_contract import Encounter, HalfSquare\n\n\nclass Mine(Encounter):\n"
GAMES = {
    "import error": ("import nothing_there", r"ModuleNotFoundError: No module named 'nothing_there' \({path}:1\)"),
    "wrong shape": (
        f"{HEAD}    def drift(self, x):\n        return x[..., :1]",
        r"Expected drift of shape \(2, 4\); got \(2, 1\)\. Index the last axes",
    ),
    "not batched": (
        f"{HEAD}    def drift(self, x):\n        return torch.stack([x[0, ..., 2:].repeat(1, 2)] * 2)",
        r"Expected (drift|dynamics) .*Index the last axes",
    ),
    "wrong gradient": (
        f"{HEAD}    def terminal_value(self, x):\n        return -HalfSquare.apply(x).sum(-1)",
        r"Expected derivatives of terminal_value that are those of its values; got .*a backward of your own must be",
    ),
    "constructor": (f"{HEAD}    def __init__(self):\n        self.horizon = 1 / 0", r"ZeroDivisionError: .*{path}:7"),
}


@pytest.mark.parametrize("kind", GAMES)
def test_a_broken_game_is_said_with_its_file_and_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    source, said = GAMES[kind]
    module = f"broken_{kind.replace(' ', '_')}"
    (tmp_path / f"{module}.py").write_text(source)
    monkeypatch.chdir(tmp_path)
    assert main(["check-game", f"{module}:Mine"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    path = re.escape(str(tmp_path / f"{module}.py"))
    assert re.search(rf"^{module}:Mine cannot be used yet: " + said.replace("{path}", path), line), line
    assert re.search(path, line), line


@pytest.mark.parametrize("wrong", [3, object])
def test_a_part_of_the_wrong_kind_is_refused_where_it_is_registered(wrong: object) -> None:
    from hno.games import games

    with pytest.raises(TypeError, match=r"A game must (be a class|extend)"):
        games.register("mine")(wrong)
