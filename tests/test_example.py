"""The example package keeps the contract and offers its game under the entry point's name."""

from __future__ import annotations

import importlib.util
import tomllib
from pathlib import Path

from hno.games.testing import check_game

FOLDER = Path(__file__).parent.parent / "examples" / "hallway"


def test_the_entry_point_names_a_game_that_keeps_the_contract():
    project = tomllib.loads((FOLDER / "pyproject.toml").read_text())["project"]
    module, name = project["entry-points"]["hno.games"]["hallway"].split(":")
    spec = importlib.util.spec_from_file_location(module, FOLDER / f"{module}.py")
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    check_game(getattr(loaded, name)())
