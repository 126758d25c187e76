"""results.json: what a run was and what came of it, valid even when a part failed."""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import hno
from hno.data.store import replace_whole
from hno.processes import Interrupted

PACKAGES = ("torch", "lightning", "torchmetrics", "hydra-core", "omegaconf", "wandb", "scipy", "safetensors")


class PrunedError(RuntimeError):
    """A run is ended because it is hopeless beside others: it has neither failed nor finished."""


def versions() -> dict[str, str]:
    """Versions of hno, Python and the packages that numbers depend on."""
    found = {"hno": hno.__version__, "python": platform.python_version()}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):  # W&B may be absent
            found[name] = version(name)
    return found


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
            "status": "running", "reason": None, "seconds": {}, "table": [], "episodes": None, "versions": versions(),
            **head,
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


@contextmanager
def recorded(results: Results) -> Iterator[None]:
    """Work whose end is in the results: finished, interrupted by which signal, or why it failed or was pruned."""
    try:
        yield
    except Interrupted as stop:
        results.update(status="interrupted", reason=str(stop))
        raise
    except (KeyboardInterrupt, SystemExit):  # Lightning turns the one into the other
        results.update(status="interrupted", reason="SIGINT")
        raise
    except PrunedError as stop:
        results.update(status="pruned", reason=str(stop))
        raise
    except BaseException as error:
        results.update(status="failed", reason=f"{type(error).__name__}: {error}")
        raise
    results.update(status="finished")
