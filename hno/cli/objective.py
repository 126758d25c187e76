"""The numbers of a job that its sweeper compares."""

from __future__ import annotations

import logging
from typing import Any

from hno.cli.media import numbers
from hno.cli.results import Results

log = logging.getLogger(__name__)

Objective = float | list[float] | None
"""What a job returns to its sweeper."""


def objective(settings: Any, results: Results | None) -> Objective:
    """The numbers of a job that its sweeper compares, by the names under `objective`.

    A failed job has none, which sweepers that search, Optuna's for one, count as a failed trial.
    """
    if results is None:
        return None
    found = {**results.content.get("metrics", {}), **numbers(results.content)}
    wanted = settings.objective if isinstance(settings.objective, list) else [settings.objective]
    if absent := [name for name in wanted if name not in found]:
        log.warning("objective: this run has no number %s; it has %s.", ", ".join(absent), ", ".join(sorted(found)))
        return None
    return [found[name] for name in wanted] if isinstance(settings.objective, list) else found[wanted[0]]
