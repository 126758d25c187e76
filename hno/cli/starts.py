"""Where episodes of evaluations begin."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hno.cli.logs import label_progress
from hno.data.labels import Request, default_cache, labels_for, safe_labels_for
from hno.evaluation.conditions import Condition
from hno.games import Game
from hno.types import Extremal


def cache_folder(choice: str | None) -> Path:
    """The folder of label files."""
    return Path(choice) if choice is not None else default_cache()


def label_solver(
    game: Game, types: Sequence[tuple[float, ...]], settings: Mapping[str, Any], cache: Path, workers: int | None
) -> Callable[[Condition], list[Extremal]]:
    """A function that solves the test starts of a condition or finds them in the cache, one set per type.

    They depend on the game, the types and the settings `starts`, `seed`, `safe` and `clearance` alone: every model
    meets the same ones. Equal starts have the same labels, the same object.
    """
    solver = functools.partial(safe_labels_for, clearance=settings["clearance"]) if settings["safe"] else labels_for

    @functools.cache
    def solve(widen: float, symmetric: bool) -> list[Extremal]:
        requests = [Request(theta, settings["starts"], settings["seed"], "test", widen, symmetric) for theta in types]
        return solver(game, requests, cache, workers=workers, report=label_progress())[0]

    return lambda condition: solve(*condition.starts)
