"""A search over settings: its trials, as `hno tune` leaves them in study.json."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from hno.report.records import sentence

FILE = "study.json"


class Trial(BaseModel):
    """A trial of a study."""

    model_config = ConfigDict(frozen=True, strict=True, allow_inf_nan=False)

    number: int
    state: str
    """"finished", "pruned", "failed" or "open"."""
    values: list[float] | None
    """By objective."""
    params: dict[str, Any]
    job: str | None
    """Its folder in that of the search; None where another process did it, elsewhere."""
    reason: str | None
    """Why it failed, or was pruned."""


class Study(BaseModel):
    """What came of a search."""

    model_config = ConfigDict(frozen=True, strict=True, allow_inf_nan=False)

    objectives: list[str]
    axes: list[str]
    best: list[int]
    """Numbers of the trials of which no other is better in everything."""
    importance: dict[str, float] | None
    trials: list[Trial]
    words: list[str]
    """What the search was asked for besides settings of its trials."""

    @property
    def finished(self) -> list[Trial]:
        """Those that have all numbers."""
        return [one for one in self.trials if one.values is not None and len(one.values) == len(self.objectives)]


def read(path: Path) -> Study | None:
    """The study of a folder; None where it has none.

    Raises:
        ValueError: it cannot be read.
    """
    if not path.exists():
        return None
    try:
        return Study.model_validate_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise ValueError(f"{path.name} cannot be read ({sentence(error)})") from error
