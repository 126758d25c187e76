"""results.json: what a run was and what came of it, valid even when a part failed."""

from __future__ import annotations

import hashlib
import json
import math
import platform
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from pydantic import BaseModel

import hno
from hno.data.store import replace_whole

PACKAGES = ("torch", "lightning", "torchmetrics", "hydra-core", "omegaconf", "wandb", "scipy", "safetensors")


def plain(config: DictConfig | BaseModel) -> dict[str, Any]:
    """A configuration as plain containers."""
    content = config.model_dump() if isinstance(config, BaseModel) else OmegaConf.to_container(config, resolve=True)
    assert isinstance(content, dict)
    return {str(key): value for key, value in content.items()}


def config_hash(config: DictConfig | BaseModel) -> str:
    """Hash of what determines a run's numbers; folders, logging and the number of workers do not."""
    content = plain(config)
    for key in ("logger", "resume", "checkpoint"):
        content.pop(key, None)
    for key in ("cache", "workers", "threads"):
        content.pop(key, None)
    for group, key in (("data", "cache"), ("data", "workers"), ("trainer", "print_every"), ("trainer", "threads")):
        content.get(group, {}).pop(key, None)
    text = json.dumps(content, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def versions() -> dict[str, str]:
    """Versions of hno, Python and the packages that numbers depend on."""
    return {"hno": hno.__version__, "python": platform.python_version(), **{name: version(name) for name in PACKAGES}}


def finite(content: Any) -> Any:
    """JSON content with null for numbers that JSON does not know: NaN and infinities."""
    if isinstance(content, Mapping):
        return {key: finite(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def write_json(path: Path, content: Any, indent: int | None = None) -> None:
    """Write a JSON file whole, with null for what JSON does not know."""
    text = json.dumps(finite(content), indent=indent, allow_nan=False)
    replace_whole(path, lambda draft: draft.write_text(text + "\n"))


class Results:
    """The content of a results.json, written after every part of a run.

    Args:
        path: the file.
        head: what is known before the run.
    """

    def __init__(self, path: Path, head: Mapping[str, Any]) -> None:
        self.path = path
        self.content: dict[str, Any] = {
            "status": "running", "reason": None, **head, "seconds": {}, "table": [],
            "episodes": None, "versions": versions(),
        }  # fmt: skip
        self.write()

    def update(self, **entries: Any) -> None:
        """Replace entries and write the file."""
        self.content.update(entries)
        self.write()

    def time(self, part: str, seconds: float) -> None:
        """Add to how long a part took and write the file."""
        self.content["seconds"][part] = round(self.content["seconds"].get(part, 0.0) + seconds, 3)
        self.write()

    def write(self) -> None:
        """Write the file whole."""
        write_json(self.path, self.content, indent=2)
