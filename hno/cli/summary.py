"""What a run prints at its end."""

from __future__ import annotations

import logging
import sys
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.fabric.utilities.exceptions import MisconfigurationException
from rich.console import Console

import hno
from hno.cli.sections import show_section
from hno.evaluation.format import short_names
from hno.evaluation.sections import sections
from hno.registry import UnknownNameError

log = logging.getLogger(__name__)

WIDTH = 140
"""Columns of text where there is no terminal to ask."""


def show(results: Mapping[str, Any], folder: Path) -> None:
    """Print the sections of every model, the comparison of models and where everything lies."""
    console = Console(width=None if sys.stdout.isatty() else WIDTH)
    models = results.get("models", [results])
    names = short_names([str(model["checkpoint"]) for model in models]) if len(models) > 1 else [""]
    for name, model in zip(names, models, strict=True):
        parts = [str(model[key]) for key in ("game", "operator", "activation")]
        show_section("table", model["table"], results, console, " / ".join([*parts, name] if name else parts))
        for key in sections.names():
            if key in model and key not in ("table", "comparison"):
                show_section(key, model[key], results, console)
    if "comparison" in results:
        show_section("comparison", results["comparison"], results, console)
    spent = ", ".join(f"{part.replace('_', ' ')} {seconds:.0f} s" for part, seconds in results["seconds"].items())
    console.print(f"Time: {spent}\nResults: {folder / 'results.json'}", soft_wrap=True)


def report(error: Exception) -> None:
    """Log what went wrong: one message for errors that were raised on purpose, a traceback for surprises."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = bool(frames) and Path(frames[-1].filename).is_relative_to(Path(hno.__file__).parent)
    meant = ours and isinstance(error, (ValueError, RuntimeError, UnknownNameError))
    expected = meant or isinstance(error, (OSError, MisconfigurationException))
    log.error("%s", error, exc_info=None if expected else error)
