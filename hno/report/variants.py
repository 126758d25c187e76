"""What tells recipes of the same names from each other, in the order in which a command line chose it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from hno.evaluation.format import NAMES, NOT_AVAILABLE

IGNORED = ("seed", "resume", "cache", "workers", "data.cache", "data.workers", "trainer.print_every", "trainer.threads")
"""Settings that do not make another recipe."""
LENGTH = 40
"""Characters of a value, at most, unless a longer one is needed to tell two recipes apart."""


def matters(key: str) -> bool:
    """Whether a setting makes another recipe."""
    return key not in IGNORED and not key.startswith("logger")


def chosen(overrides: Iterable[str]) -> dict[str, str]:
    """Settings that a command line chose, by key, but for those that make no other recipe or that a name shows."""
    pairs = (entry.lstrip("+~").partition("=")[::2] for entry in overrides)
    return {key: value for key, value in pairs if matters(key) and key not in NAMES}


def variants(choices: Sequence[Mapping[str, str]], settings: Sequence[Mapping[str, str]]) -> list[str]:
    """What tells each of some recipes from the others, no two alike.

    Args:
        choices: by recipe, what its command line chose, see `chosen`: keys that differ name it, in their order.
        settings: by recipe, all its settings: where the command lines do not tell recipes apart, each further setting
            that does, in the alphabet.
    """
    keys = [key for key in dict.fromkeys(key for one in choices for key in one) if _differs(key, choices)]
    table = [[(key, one.get(key, NOT_AVAILABLE)) for key in keys] for one in choices]
    for key in sorted({key for one in settings for key in one}):
        more = [[*row, (key, one.get(key, NOT_AVAILABLE))] for row, one in zip(table, settings, strict=True)]
        if _kinds(more) > _kinds(table):
            table = more
    short = [", ".join(f"{key}={_end(value):.{LENGTH}}" for key, value in row) for row in table]
    return short if _kinds(short) == _kinds(table) else [", ".join(f"{k}={v}" for k, v in row) for row in table]


def _kinds(rows: Sequence[object]) -> int:
    return len(set(map(str, rows)))


def _differs(key: str, of: Sequence[Mapping[str, str]]) -> bool:
    return len({one.get(key) for one in of}) > 1


def _end(value: str) -> str:
    """The last parts of a path."""
    return "/".join(value.split("/")[-3:])
