"""What results.json holds, as typed records."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, SkipValidation, TypeAdapter, ValidationError

from hno.evaluation.closed_loop import TypeRow
from hno.evaluation.format import NOT_AVAILABLE
from hno.evaluation.outcome import Outcome
from hno.evaluation.starts import Starts
from hno.report.episode import Episode, Scene

Curves = dict[str, list[tuple[int, float]]]
"""Metric -> step and value."""
Row = Mapping[str, Any]
"""A row of the collision table: the entries of `TypeRow` and its `Outcome`."""
CONSTANTS = "game.constants."
"""What settings that are constants of a game begin with."""
PLAY = ("clearance", "dt", "widen", "noise", "delay", "learns")
"""Fields of `Run` that say how episodes were played; their defaults go without saying."""


class Run(BaseModel):
    """One model: what results.json says of it, and what lies beside that file. Other entries are kept as they are."""

    model_config = ConfigDict(frozen=True, strict=True, extra="allow", allow_inf_nan=False)

    status: str
    reason: str | None = None
    """Why it failed."""
    game: str = NOT_AVAILABLE
    operator: str = NOT_AVAILABLE
    function: str = NOT_AVAILABLE
    activation: str = NOT_AVAILABLE
    seed: int | None = None
    steps: int | None = None
    checkpoint: str | None = None
    seconds: dict[str, float] = {}
    metrics: dict[str, float | None] = {}
    versions: dict[str, str] = {}
    label_statistics: list[dict[str, Any]] = []
    config: dict[str, Any] | None = None
    clearance: float = 0.02
    constraint_unit: str = "m"
    dt: float = 0.02
    widen: float = 1
    noise: float = 0
    delay: int = 0
    learns: str | None = None
    test_seed: int | None = None
    table: SkipValidation[list[Row]]
    """One row for every type."""

    name: str = ""
    """Its folder, relative to the one that was asked for."""
    landscape: SkipValidation[Path | None] = None
    """The file of its landscape."""
    settings: SkipValidation[dict[str, str]] = {}
    """The configuration, dotted names."""
    curves: SkipValidation[Curves] = {}
    episodes: SkipValidation[list[Episode]] = []
    scene: SkipValidation[Scene] = Scene()
    """What is drawn around the players of its episodes."""
    outcomes: SkipValidation[dict[tuple[float, ...], Starts]] = {}
    """What came of single starts, by type; empty where it was not kept."""
    command: SkipValidation[str | None] = None
    """The command line that repeats it."""
    overrides: SkipValidation[tuple[str, ...]] = ()
    """What this command line chose, in its order."""
    notes: SkipValidation[list[str]] = []
    """What could not be read, and why."""

    @property
    def finished(self) -> bool:
        """Whether it came to its end without failing."""
        return self.status == "finished"

    @property
    def conditions(self) -> str:
        """Changed constants of the game and how episodes were played, as far as that is not usual."""
        constants = {key.removeprefix(CONSTANTS): text for key, text in self.settings.items() if CONSTANTS in key}
        usual = type(self).model_fields
        play = {name: getattr(self, name) for name in PLAY if getattr(self, name) != usual[name].default}
        said = [f"{name} {text}" for name, text in sorted(constants.items())]
        return ", ".join(
            said + [f"{name} {value if isinstance(value, str) else f'{value:g}'}" for name, value in play.items()]
        )

    @property
    def entries(self) -> Mapping[str, Any]:
        """Entries of results.json that have no field, such as sections of an evaluation."""
        return self.model_extra or {}

    def spent(self, stage: str) -> float | None:
        """Time that a stage took, s; "total" is the sum of all."""
        return self.seconds.get(stage, math.fsum(self.seconds.values()) if stage == "total" and self.seconds else None)


_ROW = TypeAdapter(TypeRow, config=ConfigDict(strict=True, allow_inf_nan=False))


def type_row(content: Any) -> Row:
    """A row of the collision table from its entry of results.json.

    Raises:
        ValueError: entries are missing, of the wrong type, or contradict each other.
    """
    if not isinstance(content, dict):
        raise ValueError(f"expected an object, got {content!r:.60}")
    nested = {key: content[key] for key in TypeRow._fields if key in content}
    nested["outcome"] = {key: content[key] for key in Outcome._fields if key in content}
    row = _ROW.validate_json(json.dumps(nested))
    if not 0 <= row.outcome.collisions <= row.outcome.safe_starts:
        raise ValueError(f"{row.outcome.collisions} collisions of {row.outcome.safe_starts} safe starts")
    return row.content()


def sentence(error: Exception) -> str:
    """What is wrong; of several entries that do not fit, the first."""
    if not isinstance(error, ValidationError):
        return str(error)
    first = error.errors()[0]
    place = ".".join(str(step) for step in first["loc"]) or "content"
    found = "" if first["type"] == "missing" else f", got {first['input']!r:.60}"
    return f"{place}: {first['msg'][0].lower()}{first['msg'][1:]}{found}"
