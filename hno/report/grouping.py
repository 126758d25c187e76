"""Which runs belong to one recipe, and what tells recipes apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from hno.report.aggregate import Recipe
from hno.report.runs import NOT_AVAILABLE, Run

IGNORED = ("seed", "resume", "cache", "workers", "data.cache", "data.workers", "trainer.print_every", "trainer.threads")
"""Settings that do not make another recipe."""
SHOWN = 3
"""Differing settings that are named in a recipe's label."""


def recipes(runs: Sequence[Run]) -> list[Recipe]:
    """Group runs whose settings are equal but for the seed."""
    groups: dict[tuple[str, ...], dict[tuple[tuple[str, str], ...], list[Run]]] = {}
    for run in runs:
        names = (run.game, run.operator, run.activation)
        groups.setdefault(names, {}).setdefault(tuple(sorted(relevant(run).items())), []).append(run)
    return [
        _recipe(names, variant, same)
        for names, group in sorted(groups.items())
        for variant, same in zip(_variants([dict(key) for key in group]), group.values(), strict=True)
    ]


def relevant(run: Run) -> dict[str, str]:
    """The settings that make a recipe; without a configuration, what the results say."""
    chosen = {key: text for key, text in run.settings.items() if key not in IGNORED and not key.startswith("logger.")}
    return chosen or {"steps": str(run.content.get("steps", NOT_AVAILABLE)), "conditions": run.conditions}


def _variants(settings: Sequence[Mapping[str, str]]) -> list[str]:
    """What tells each of some settings from the others."""
    keys = sorted({key for one in settings for key in one})
    differing = [key for key in keys if len({one.get(key) for one in settings}) > 1]
    more = [f"{len(differing) - SHOWN} more"] if len(differing) > SHOWN else []
    return [", ".join([f"{key}={_short(one.get(key))}" for key in differing[:SHOWN]] + more) for one in settings]


def _short(text: str | None) -> str:
    """A setting for a label: of a path its last three parts, of anything else the beginning."""
    if text is None:
        return NOT_AVAILABLE
    return "/".join(text.split("/")[-3:]) if "/" in text else text[:40]


def _recipe(names: tuple[str, ...], variant: str, runs: Sequence[Run]) -> Recipe:
    last: dict[object, Run] = {}
    for run in runs:
        if run.finished:
            last[run.seed, run.content.get("test_seed")] = run
    counted = tuple(last.values())
    repeated = tuple(run for run in runs if run.finished and all(run is not other for other in counted))
    failed = sum(run.status == "failed" for run in runs)
    unfinished = len(runs) - len(counted) - len(repeated) - failed
    special = ", ".join(sorted({text for run in counted for text in (_constants(run), run.conditions)} - {""}))
    game, operator, activation = names
    return Recipe(game, operator, activation, variant, special, counted, repeated, unfinished, failed)


def _constants(run: Run) -> str:
    changed = {key: text for key, text in sorted(run.settings.items()) if key.startswith("game.constants.")}
    return ", ".join(f"{key.removeprefix('game.constants.')} {text}" for key, text in changed.items())
