"""A library that is imported is a listed dependency."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
OPTIONAL = {"episodes", "export", "report", "tune"}
"""Extras whose libraries hno imports where they are installed."""


def normal(name: str) -> str:
    """A distribution's name as PEP 503 writes it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def listed(*extras: str) -> set[str]:
    """Distributions that the package depends on, with those of extras."""
    entries = [*PROJECT["dependencies"], *(one for extra in extras for one in PROJECT["optional-dependencies"][extra])]
    return {normal(re.split(r"[\[<>=! ;]", entry)[0]) for entry in entries}


def imported(source: str) -> set[str]:
    """Top-level modules that a source imports, but for the standard library and hno."""
    names = set[str]()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add(str(node.module))
    return {name.split(".")[0] for name in names} - set(sys.stdlib_module_names) - {"hno"}


def test_what_is_imported_is_listed() -> None:
    offered, known = packages_distributions(), listed(*OPTIONAL)
    for path in sorted((ROOT / "hno").rglob("*.py")):
        for name in imported(path.read_text(encoding="utf-8")):
            distributions = {normal(found) for found in offered.get(name, [name])}
            assert distributions & known, f"{path} imports {name}, which pyproject.toml does not list"


def test_the_reader_sees_every_form_of_import() -> None:
    source = "import numpy as np, os\nfrom yaml import load\ndef f():\n    import torch.nn\nfrom . import x\nimport hno"
    assert imported(source) == {"numpy", "yaml", "torch"}
