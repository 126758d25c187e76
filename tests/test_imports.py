"""Imports go one way: later subpackages know earlier ones, never the reverse."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import hno

ROOT = Path(hno.__file__).parent
LEVELS = (
    {"types", "registry", "processes", "runtime"},
    {"games"},
    {"pontryagin"},
    {"losses", "data"},
    {"operators"},
    {"export"},
    {"control"},
    {"training", "evaluation"},
    {"report"},
    {"hno"},
    {"cli"},
    {"__main__"},
)
"""Who may import whom: a part imports itself and the levels before its own."""
STRANGERS = {("data", "operators"), ("operators", "data"), ("training", "evaluation"), ("evaluation", "training")}
"""Parts that meet in the command line only."""


def part_of(module: str) -> str:
    """The part of the package that a module belongs to; "hno" is its own `__init__`."""
    names = module.split(".")
    return names[1] if len(names) > 1 else "hno"


def level(part: str) -> int:
    """Place of a part in the order.

    Raises:
        AssertionError: the part has none yet.
    """
    places = [place for place, parts in enumerate(LEVELS) if part in parts]
    assert places, f"hno.{part} has no place in the import order; add it to LEVELS."
    return places[0]


def imported(source: str, module: str, *, is_package: bool = False) -> Iterator[str]:
    """Modules of hno that a source imports, inside functions and for type checking too."""
    parts = {part for names in LEVELS for part in names}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] == "hno")
        elif isinstance(node, ast.ImportFrom):
            base = absolute(node, module, is_package)
            if base == "hno":
                yield from (f"hno.{alias.name}" if alias.name in parts else "hno" for alias in node.names)
            elif base.startswith("hno."):
                yield base


def absolute(node: ast.ImportFrom, module: str, is_package: bool) -> str:
    """The module that a from-import names, with leading dots resolved."""
    if node.level == 0:
        return node.module or ""
    package = module.split(".") if is_package else module.split(".")[:-1]
    names = package[: len(package) - node.level + 1] + ([node.module] if node.module else [])
    return ".".join(names)


def violations(source: str, module: str, *, is_package: bool = False) -> list[str]:
    """Edges of a source that the order does not allow."""
    here = part_of(module)
    if module == "hno":
        return []
    found = []
    for target in imported(source, module, is_package=is_package):
        there = part_of(target)
        downwards = level(there) < level(here) and (here, there) not in STRANGERS
        if here != there and not downwards:
            found.append(f"{module} imports {target}")
    return found


def modules() -> Iterator[tuple[str, Path]]:
    for path in sorted(ROOT.rglob("*.py")):
        names = path.relative_to(ROOT.parent).with_suffix("").parts
        yield ".".join(names[:-1] if names[-1] == "__init__" else names), path


def test_every_import_follows_the_order():
    found = [
        edge
        for module, path in modules()
        for edge in violations(path.read_text(encoding="utf-8"), module, is_package=path.name == "__init__.py")
    ]
    assert found == []


def test_the_walk_sees_the_whole_package():
    seen = {module for module, _ in modules()}
    assert {"hno", "hno.types", "hno.games.base", "hno.pontryagin.solve", "hno.operators.base"} <= seen
    edges = set(imported((ROOT / "pontryagin" / "solve.py").read_text(encoding="utf-8"), "hno.pontryagin.solve"))
    assert {"hno.games", "hno.types", "hno.pontryagin.collocation"} <= edges


@pytest.mark.parametrize(
    ("module", "source", "edge"),
    [
        ("hno.games.toy", "import hno.data.store", "hno.data.store"),
        ("hno.games.toy", "from hno.pontryagin import solve", "hno.pontryagin"),
        ("hno.games.toy", "from hno import operators", "hno.operators"),
        ("hno.data.toy", "from hno.operators.base import ValueOperator", "hno.operators.base"),
        ("hno.operators.toy", "from hno import data", "hno.data"),
        ("hno.operators.toy", "def late():\n    from hno.data import store", "hno.data"),
        ("hno.losses.toy", "import numpy, hno.data", "hno.data"),
        ("hno.data.toy", "if TYPE_CHECKING:\n    from hno.losses import LossTerm", "hno.losses"),
        ("hno.pontryagin.toy", "from ..evaluation import rollout", "hno.evaluation"),
        ("hno.pontryagin.toy", "from .. import evaluation", "hno.evaluation"),
        ("hno.types", "from hno import registry", "hno.registry"),
        ("hno.evaluation.toy", "from hno import __version__", "hno"),
        ("hno.evaluation.toy", "import hno", "hno"),
        ("hno.report.toy", "from hno.cli.train import main", "hno.cli.train"),
    ],
)
def test_a_forbidden_edge_is_found(module, source, edge):
    assert violations(source, module) == [f"{module} imports {edge}"]


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("hno.games.toy", "from hno.games.base import Game\nfrom hno.registry import Registry\nimport torch"),
        ("hno.games.toy", "from .base import Game"),
        ("hno.operators.toy", "from hno.losses import LossTerm\nfrom hno import games"),
        ("hno.cli.toy", "import hno\nfrom hno.data import GameData\nfrom hno.operators import operators"),
        ("hno", "from hno.cli import train"),
    ],
)
def test_an_allowed_edge_is_left_alone(module, source):
    assert violations(source, module) == []


def test_a_package_resolves_its_dots_from_itself():
    assert violations("from . import base", "hno.games", is_package=True) == []
    assert violations("from .. import cli", "hno.games", is_package=True) == ["hno.games imports hno.cli"]


def test_a_part_without_a_place_is_reported():
    with pytest.raises(AssertionError, match=r"hno\.novelty has no place in the import order"):
        violations("import hno.types", "hno.novelty.toy")
