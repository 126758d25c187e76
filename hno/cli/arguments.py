"""The words of a command line: flags, key=value, and others."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from typing import NamedTuple

from hno.registry import unknown_name

FLAGS = {
    "--dry-run": "print the configuration (with -m: the jobs) after it has been checked, and end",
    "--to": "PATH: where results go",
    "--multirun": "(or -m) run every combination of values that are separated by commas; anywhere on the line",
    "--config-dir": "FOLDER: choices of your own, such as FOLDER/experiment/mine.yaml",
    "--help": "this text",
    "--version": "hno's version",
    "--shell-completion": "install=SHELL, for its eval: completion of keys and choices",
}
"""Every flag, anywhere on the line."""
SHORT = {"-h": "--help", "-m": "--multirun", "-cd": "--config-dir", "-sc": "--shell-completion"}
WITH_VALUE = ("--to", "--config-dir")
TYPES = re.compile(r"""(\+*(?:theta|unseen|(?:\w+\.)*types)=)([-+.\d][^'"\[\]{}$]*[,;][^'"\[\]{}$]*)""")
"""Player types as a list of numbers, which Hydra's grammar takes in quotes only."""

SHARE = re.compile(r"\+*(sampler\.\w+)=([\d.,e-]+)")
"""The share of a source by itself: its options stay as they are."""


class UsageError(ValueError):
    """Words that make no command; the message says what was expected."""


class Arguments(NamedTuple):
    """A command line in parts, which may have come in any order."""

    words: list[str]
    """Those that are neither flags nor overrides."""
    overrides: list[str]
    """key=value and ~key."""
    flags: dict[str, str]
    """Long forms and values; those without a value have ""."""


def parse(given: Sequence[str]) -> Arguments:
    """Sort words into flags, overrides and others.

    Raises:
        UsageError: an unknown flag, or one without the value that it needs.
    """
    found, rest = Arguments([], [], {}), list(given)
    while rest:
        word = rest.pop(0)
        name, equals, value = word.partition("=")
        if not word.startswith("-"):
            (found.overrides if equals or word.startswith("~") else found.words).append(word)
            continue
        flag = SHORT.get(name, name)
        if flag not in FLAGS:
            raise UsageError(unknown_name("flag", name, [*FLAGS]))
        if not equals and flag in WITH_VALUE:
            if not rest:
                raise UsageError(f"{name} needs a value.")
            value = rest.pop(0)
        found.flags[flag] = value
    return found


def rewritten(override: str, groups: Collection[str], untouched: Collection[str]) -> str:
    """An override as Hydra is to see it: any key may be set, since the schema judges the result.

    A list of player types is quoted, `sampler.<source>=0.2` means the source's share; `a.b=c` and `+a.b=c` become
    `++a.b=c`, `+group=choice` becomes `group=choice`.

    Args:
        override: as given.
        groups: those that the command composes.
        untouched: further keys, which stay as given.
    """
    key, equals, value = override.partition("=")
    bare = key.lstrip("+").split("@")[0]
    if key.startswith("~") or bare.startswith(("hydra.", "hydra/")):
        return override
    if bare in groups:
        return f"{key.lstrip('+')}{equals}{value}"
    if bare in untouched:
        return override
    types, share = TYPES.fullmatch(override), SHARE.fullmatch(override)
    if share is not None:
        return f"++{share[1]}.share={share[2]}"
    return f"++{key.lstrip('+')}={repr(types[2]) if types else value}"
