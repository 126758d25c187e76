"""No file from outside can run code: nothing in the sources unpickles, evaluates text or imports what a file names."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import hno

ROOT = Path(hno.__file__).parent.parent
SOURCES = [ROOT / "train.py", ROOT / "evaluate.py", *(ROOT / "hno").rglob("*.py"), *(ROOT / "benchmarks").glob("*.py")]
FORBIDDEN = {
    "eval", "exec", "compile", "__import__", "joblib.load", "joblib.dump", "hydra.utils.instantiate",
    "hydra.utils.call", "hydra.utils.get_class", "hydra.utils.get_method", "hydra.utils.get_object",
}  # fmt: skip
"""Functions that run what they are given, by their full name."""
MODULES = {"pickle", "cloudpickle", "dill", "shelve", "marshal"}
"""Whose functions do; their exceptions may be named."""
ONLY_WITH = {"torch.load": ("weights_only", True)}
"""Functions that are safe with one argument."""
NEVER_WITH = {"numpy.load": ("allow_pickle", True)}
"""Functions that are unsafe with one argument."""
YAML = {"yaml.load", "yaml.unsafe_load", "yaml.full_load", "yaml.load_all"}


def names(tree: ast.AST) -> dict[str, str]:
    """What the names of a module stand for, such as {"np": "numpy", "loads": "pickle.loads"}."""
    known: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            known |= {entry.asname: entry.name for entry in node.names if entry.asname}
        elif isinstance(node, ast.ImportFrom):
            known |= {entry.asname or entry.name: f"{node.module}.{entry.name}" for entry in node.names}
    return known


def full(node: ast.expr, known: dict[str, str]) -> str:
    """The full name of what is called; empty where it has none."""
    if isinstance(node, ast.Name):
        return known.get(node.id, node.id)
    if isinstance(node, ast.Attribute):
        base = full(node.value, known)
        return f"{base}.{node.attr}" if base else ""
    return ""


def unsafe(source: str) -> Iterator[str]:
    """Calls of a source that could run what a file says."""
    tree = ast.parse(source)
    known = names(tree)
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        name = full(call.func, known)
        given = {word.arg: word.value.value for word in call.keywords if isinstance(word.value, ast.Constant)}
        needed, refused = ONLY_WITH.get(name), NEVER_WITH.get(name)
        if (
            name in FORBIDDEN | YAML
            or (name.split(".")[0] in MODULES and not name.endswith("Error"))
            or (needed is not None and given.get(needed[0]) is not needed[1])
            or (refused is not None and given.get(refused[0]) is refused[1])
        ):
            yield f"line {call.lineno}: {name}"


def test_no_source_runs_what_a_file_says() -> None:
    found = {str(path.relative_to(ROOT)): list(unsafe(path.read_text())) for path in SOURCES}
    assert len(found) > 100
    assert {path: calls for path, calls in found.items() if calls} == {}


@pytest.mark.parametrize(
    "source",
    [
        "import pickle; pickle.load(file)",
        "from pickle import loads as read; read(content)",
        "import pickle as p; p.Unpickler(file).load()",
        "import torch; torch.load(path)",
        "import torch; torch.load(path, weights_only=False)",
        "import torch; torch.load(path, weights_only=chosen)",
        "from torch import load; load(path)",
        "import joblib; joblib.load(path)",
        "import numpy as np; np.load(path, allow_pickle=True)",
        "import yaml; yaml.load(text)",
        "eval(text)",
        "exec(text)",
        "compile(text, name, 'exec')",
        "from hydra.utils import instantiate; instantiate(config)",
        "import hydra; hydra.utils.get_class(name)",
    ],
)
def test_the_check_finds(source: str) -> None:
    assert len(list(unsafe(source))) == 1


@pytest.mark.parametrize(
    "source", ["torch.load(path, weights_only=True)", "numpy.load(path)", "torch.compile(f)", "operator.eval()"]
)
def test_the_check_leaves(source: str) -> None:
    assert list(unsafe(source)) == []
