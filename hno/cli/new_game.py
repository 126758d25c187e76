"""`hno new-game`: a package with a small working game, to be changed into one's own."""

from __future__ import annotations

import keyword
import re
from importlib.resources import files
from pathlib import Path
from string import Template

from hno.cli.arguments import Arguments, UsageError

NEXT = """
Next, in {folder}:
  pip install -e . --no-deps
  hno check-game {name}
  hno train game={name} experiment=smoke
The game is in {package}/__init__.py, its configuration in {package}/conf/game/{name}.yaml, its test in tests/."""

TAKEN = ("Box", "CollisionAvoidance", "Tensor")
"""Classes that the game's file imports."""


def run(given: Arguments) -> int:
    """`hno new-game NAME [--to FOLDER]`; nothing is overwritten."""
    if len(given.words) != 1 or given.overrides:
        raise UsageError("Name the game, one word: hno new-game roundabout [--to FOLDER].")
    (name,) = given.words
    package, cls = f"hno_{name}", "".join(part.title() for part in name.split("_"))
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise UsageError(f"A game's name is made of small letters, digits and _, as a module's; got {name!r}.")
    if any(keyword.iskeyword(word) or word in TAKEN for word in (name, cls)):
        raise UsageError(f"{name!r} means something else in the game's file already: choose another name.")
    from hno.cli.confs import choices

    if name in choices("game"):
        raise UsageError(f"There is a game {name!r} already (see `hno list game`): choose another name.")
    folder = Path(given.flags.get("--to", name))
    content = {
        folder / "pyproject.toml": "pyproject.toml.txt",
        folder / package / "__init__.py": "game.py.txt",
        folder / package / "conf" / "game" / f"{name}.yaml": "game.yaml.txt",
        folder / "tests" / f"test_{name}.py": "test.py.txt",
    }
    there = [str(path) for path in content if path.exists()]
    if there:
        raise FileExistsError(f"Nothing was written: there already: {', '.join(there)}.")
    for path, template in content.items():
        text = Template((files("hno.cli") / "templates" / template).read_text(encoding="utf-8"))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text.substitute(name=name, package=package, cls=cls, dashed=name.replace("_", "-")), "utf-8")
        print(path)
    print(NEXT.format(folder=folder, name=name, package=package))
    return 0
