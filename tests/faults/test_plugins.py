"""Plugins that cannot be loaded."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
BROKEN = {
    "importing": ("broken:Game", "import nothing_there", "ModuleNotFoundError"),
    "syntax": ("broken:Game", "class Game(", "SyntaxError"),
    "exiting": ("broken:Game", "raise SystemExit(3)", "SystemExit: 3"),
    "number": ("broken:Game", "Game = 3", "must be a class or a function that builds one; got 3"),
    "kind": ("broken:Game", "class Game: pass", "must extend hno.games.base.Game"),
    "unnamed": ("broken:Gmae", "class Game: pass", "no attribute 'Gmae'"),
    "malformed": ("not a module", "", "AttributeError"),
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
        (info / "entry_points.txt").write_text(f"[hno.games]\n{name} = {place}\n{also}")
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


@pytest.mark.parametrize("wrong", [3, object])
def test_a_part_of_the_wrong_kind_is_refused_where_it_is_registered(wrong: object) -> None:
    from hno.games import games

    with pytest.raises(TypeError, match=r"A game must (be a class|extend)"):
        games.register("mine")(wrong)
