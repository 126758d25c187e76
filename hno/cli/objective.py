"""The numbers of a job that its sweeper compares."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

from hno.cli.media import numbers

log = logging.getLogger(__name__)

Objective = float | list[float] | None
"""What a job returns to its sweeper."""


def objective(settings: Any, results: Mapping[str, Any]) -> Objective:
    """The numbers of a job that its sweeper compares, by the names under `objective`.

    A job without them returns None, as a failed one does, which sweepers that search count as a failed trial. So does
    one that was pruned.
    """
    if results.get("status") == "pruned":
        return None
    wanted = named(settings.objective)
    found = present(wanted, results)
    if absent := [name for name in wanted if name not in found]:
        known = ", ".join(sorted(_known(results)))
        log.warning("objective: this run has no number %s; it has %s.", ", ".join(absent), known)
        return None
    return [found[name] for name in wanted] if isinstance(settings.objective, list) else found[wanted[0]]


def named(objective: str | Sequence[str]) -> list[str]:
    """Names of one objective, or of several."""
    return [objective] if isinstance(objective, str) else [*objective]


def present(names: Sequence[str], results: Mapping[str, Any]) -> dict[str, float]:
    """Those of some numbers that a job has."""
    found = _known(results)
    return {name: found[name] for name in names if name in found}


def _known(results: Mapping[str, Any]) -> dict[str, float]:
    measured = {name: value for name, value in results.get("metrics", {}).items() if value is not None}
    return {**measured, **numbers(results)}
