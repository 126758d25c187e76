"""Where episodes of evaluations begin."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig

from hno.cli.logs import label_progress
from hno.data.labels import Request, default_cache, labels_for, safe_labels_for
from hno.games import Game
from hno.types import Extremal


def cache_folder(choice: str | None) -> Path:
    """The folder of label files."""
    return Path(choice) if choice is not None else default_cache()


def solve_starts(
    game: Game,
    types: Sequence[tuple[float, ...]],
    settings: DictConfig,
    cache: Path,
    workers: int | None,
    widen: float,
) -> tuple[list[Extremal], float]:
    """Labels of the test starts of every type, from the cache or solved, and the seconds that this took.

    They depend on the game, the types and the settings alone: every model meets the same ones.

    Args:
        game: the game.
        types: player types.
        settings: `starts`, `seed`, `safe` and `clearance`.
        cache: folder of label sets.
        workers: label processes; the number of cores by default.
        widen: width of the start box in units of the game's.
    """
    requests = [Request(theta, settings.starts, settings.seed, "test", widen) for theta in types]
    solver = functools.partial(safe_labels_for, clearance=settings.clearance) if settings.safe else labels_for
    return solver(game, requests, cache, workers=workers, report=label_progress())
