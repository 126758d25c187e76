"""Files of configuration that users bring: they choose, and run nothing."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from hno.cli.arguments import UsageError

HYDRA = {"run": None, "sweep": None, "sweeper": {"params", "max_batch_size"}, "job": {"name", "chdir"}}
"""What a file of the user's may say of Hydra: the rest can name code, commands and files to write."""


def check_harmless(file: Path) -> None:
    """Refuse a file of configuration that could run code: Hydra calls whatever `_target_` names.

    Raises:
        UsageError: with the file and what it says; also where it cannot be read.
    """
    try:
        text = file.read_text(encoding="utf-8")
        content = OmegaConf.to_container(OmegaConf.create(text), resolve=False)
    except Exception as error:
        raise UsageError(f"{file} cannot be read ({type(error).__name__}: {error}).") from error
    entries: Any = content if isinstance(content, dict) else {}
    hydra_entries: Any = entries.get("hydra") or {}
    said = [f"hydra.{key}" for key, value in hydra_entries.items() if not _allowed(key, value)]
    said += [str(key) for key in _keys(content) if key in ("_target_", "()")]
    said += [f"hydra.{key}" for key in entries if str(key).startswith("hydra.")]
    said += [str(entry) for entry in entries.get("defaults") or () if "@" in str(entry) and "hydra" in str(entry)]
    said += re.findall(r"@package\s+\S*hydra\S*", text) + (["its place"] if "hydra" in file.parts[-3:-1] else [])
    if said:
        raise UsageError(
            f"{file}: {said[0]} could run code or write files elsewhere. A file may choose, set options, and of hydra "
            f"{', '.join(HYDRA)}; give the rest on the command line."
        )


def _allowed(key: str, value: Any) -> bool:
    known = HYDRA.get(key, set())
    return known is None or (isinstance(value, dict) and set(value) <= known and bool(known))


def _keys(content: Any) -> Iterator[Any]:
    """Every key of nested containers."""
    if isinstance(content, dict):
        yield from content
    for entry in content.values() if isinstance(content, dict) else content if isinstance(content, list) else ():
        yield from _keys(entry)
