"""`hno new-game`: a package with a small working game, to be changed into one's own."""

from __future__ import annotations

import keyword
import re
import sys
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
    name = given.words[0]
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise UsageError(f"A game's name is made of small letters, digits and _, as a module's; got {name!r}.")
    if any(keyword.iskeyword(word) or word in TAKEN for word in (name, class_name(name))):
        raise UsageError(f"{name!r} means something else in the game's file already: choose another name.")
    from hno.cli.config import choices

    if name in choices("game"):
        raise UsageError(f"There is a game {name!r} already (see `hno list game`): choose another name.")
    folder = Path(given.flags.get("--to", name))
    content = contents(name)
    there = [str(folder / path) for path in content if (folder / path).exists()]
    if there:
        print(f"Nothing was written: there already: {', '.join(there)}.", file=sys.stderr)
        return 1
    for path, text in content.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text, encoding="utf-8")
        print(folder / path)
    print(NEXT.format(folder=folder, name=name, package=f"hno_{name}"))
    return 0


def class_name(name: str) -> str:
    """The name of a game's class."""
    return "".join(part.title() for part in name.split("_"))


def contents(name: str) -> dict[str, str]:
    """Paths inside the new folder, and what to write there."""
    package, cls = f"hno_{name}", class_name(name)
    names = {"name": name, "package": package, "cls": cls, "dashed": name.replace("_", "-")}
    paths = {
        "pyproject.toml.txt": "pyproject.toml",
        "game.py.txt": f"{package}/__init__.py",
        "game.yaml.txt": f"{package}/conf/game/{name}.yaml",
        "test.py.txt": f"tests/test_{name}.py",
    }
    templates = files("hno.cli") / "templates"
    return {
        path: Template((templates / file).read_text(encoding="utf-8")).substitute(names) for file, path in paths.items()
    }
