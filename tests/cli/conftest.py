from __future__ import annotations

import json
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import pytest
import torch

from hno.cli import evaluate, pages, train
from hno.cli.main import main
from hno.data import datamodule
from hno.games import Game, make
from hno.operators import make_operator
from hno.training.checkpoint import Provenance, record
from hno.training.saving import seal
from tests.fakes import small_architecture

SMOKE = ("experiment=smoke", "data.types=[[1,1]]", "data.workers=1", "evaluation.dt=0.25")
"""A run of seconds, on labels that every test shares."""


class Outcome(NamedTuple):
    """What a command left behind."""

    code: int
    """Exit code."""
    text: str
    """Everything it printed."""
    folder: Path
    """Its output folder."""

    @property
    def results(self) -> dict[str, Any]:
        """Content of results.json; numbers that JSON does not know are refused."""

        def refuse(constant: str) -> None:
            raise AssertionError(f"results.json holds {constant}")

        return json.loads((self.folder / "results.json").read_text(), parse_constant=refuse)


Command = Callable[..., Outcome]


@pytest.fixture
def clean_globals() -> Iterator[None]:
    """Undo what a command sets for its whole process: logging, warnings and environment."""
    root, lightning = logging.getLogger(), logging.getLogger("lightning.pytorch")
    saved = [(logger, logger.handlers[:], logger.level, logger.propagate) for logger in (root, lightning)]
    format_warning, environment = warnings.formatwarning, dict(os.environ)
    yield
    logging.captureWarnings(False)
    warnings.formatwarning = format_warning
    for logger, handlers, level, propagate in saved:
        logger.handlers[:], logger.level, logger.propagate = handlers, level, propagate
    os.environ.clear()
    os.environ.update(environment)


@pytest.fixture
def no_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands say where their page would be, without the seconds that it takes."""
    monkeypatch.setattr(pages, "write", lambda folder: f"Page: {folder}")


@pytest.fixture
def command(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    clean_globals: None,
    no_pages: None,
) -> Command:
    """Run a command in this process, as the command line would, but without pictures, landscapes and pages.

    It gets a folder of its own, but for a run that is resumed: the one before.
    """
    monkeypatch.setattr(evaluate, "draw_typical", lambda *arguments: None)
    monkeypatch.setattr(evaluate, "write_landscape", lambda *arguments: {})  # seconds, for the page alone

    folders = [tmp_path / "run"]

    def run(name: str, *words: str, folder: Path | Literal["own", "none"] = "own") -> Outcome:
        if folder == "own" and folders[-1].exists() and not any(word.startswith("resume=") for word in words):
            folders.append(tmp_path / f"run_{len(folders) + 1}")
        chosen = folder if isinstance(folder, Path) else folders[-1]
        monkeypatch.setattr(sys, "argv", [name])
        capsys.readouterr()
        to = [f"hydra.run.dir={chosen}"] if name in ("train", "evaluate") and folder != "none" else []
        code: int | str | None
        try:
            code = main([name, *words, *to])
        except SystemExit as stop:  # Lightning's, after an interruption
            code = stop.code
        return Outcome(int(code or 0), "".join(capsys.readouterr()), chosen)

    return run


@pytest.fixture
def no_labels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Expensive work fails the test: what can be known before must be said before."""

    def never(*arguments: object, **options: object) -> None:
        raise AssertionError("labels were asked for")

    for module, name in (
        (datamodule, "labels_for"), (evaluate, "labels_for"), (evaluate, "safe_labels_for"), (train, "safe_labels_for"),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, never)


def refused(run: Outcome, *fragments: str) -> None:
    """The command failed with one clear message."""
    assert run.code != 0
    for fragment in fragments:
        assert fragment in run.text
    assert "Traceback" not in run.text
    assert "labels were asked for" not in run.text


@pytest.fixture
def random_checkpoint(tmp_path: Path) -> Path:
    """A narrow-road operator with random weights, as training would have saved it."""
    return save_random(tmp_path / "random" / "last.ckpt")


def save_random(path: Path, game: Game | None = None, method: str = "hno", seed: int = 0, also: float = 1.0) -> Path:
    """An operator with random weights as training would have saved it, trained at (1, 1) and (also, also)."""
    torch.manual_seed(seed)
    game = game or make("narrow_road")
    architecture = small_architecture("sin")
    weights = make_operator(game, architecture).state_dict()
    origin = Provenance(method, list(dict.fromkeys([(1.0, 1.0), (also, also)])), 0, "any")
    path.parent.mkdir()
    content = {"state_dict": {f"operator.{name}": weight for name, weight in weights.items()}}
    path.write_bytes(seal(content | record(game, architecture, origin)))
    return path
