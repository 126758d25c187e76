"""The numbers of a job that its sweeper compares."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from hno.cli.media import numbers

log = logging.getLogger(__name__)

Objective = float | list[float] | None
"""What a job returns to its sweeper."""


def objective(settings: Any, results: Mapping[str, Any]) -> Objective:
    """The numbers of a job that its sweeper compares, by the names under `objective`.

    A job without them returns None, as a failed one does, which sweepers that search, Optuna's for one, count as a
    failed trial.
    """
    found = {**results.get("metrics", {}), **numbers(results)}
    wanted = settings.objective if isinstance(settings.objective, list) else [settings.objective]
    if absent := [name for name in wanted if name not in found]:
        log.warning("objective: this run has no number %s; it has %s.", ", ".join(absent), ", ".join(sorted(found)))
        return None
    return [found[name] for name in wanted] if isinstance(settings.objective, list) else found[wanted[0]]
