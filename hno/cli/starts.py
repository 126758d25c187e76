"""Where episodes of evaluations begin."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
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


class TestLabels:
    """Labels of test starts, from the cache or solved; those of equal starts are the same object.

    They depend on the game, the types and the settings alone: every model meets the same ones.

    Args:
        game: the game.
        types: player types.
        settings: `starts`, `seed`, `safe` and `clearance`.
        cache: folder of label sets.
        workers: label processes; the number of cores by default.
    """

    __test__ = False  # the name is no promise to pytest

    def __init__(
        self,
        game: Game,
        types: Sequence[tuple[float, ...]],
        settings: Mapping[str, Any],
        cache: Path,
        workers: int | None,
    ) -> None:
        self.game, self.types, self.settings, self.cache, self.workers = game, types, settings, cache, workers
        self.seconds = 0.0
        self._known: dict[tuple[float, bool], list[Extremal]] = {}

    def __call__(self, condition: Condition) -> list[Extremal]:
        """Labels of the starts of a condition, one set per type."""
        if condition.starts not in self._known:
            self._known[condition.starts], seconds = self._solve(condition)
            self.seconds += seconds
        return self._known[condition.starts]

    def _solve(self, condition: Condition) -> tuple[list[Extremal], float]:
        starts, seed, clearance = (self.settings[name] for name in ("starts", "seed", "clearance"))
        requests = [Request(theta, starts, seed, "test", *condition.starts) for theta in self.types]
        solver = functools.partial(safe_labels_for, clearance=clearance) if self.settings["safe"] else labels_for
        return solver(self.game, requests, self.cache, workers=self.workers, report=label_progress())
