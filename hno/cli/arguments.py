"""The words of a command line: flags, key=value, and others."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

from hno.registry import unknown_name

FLAGS = {
    "--dry-run": "print the configuration (with -m: the jobs) after it has been checked, and end",
    "--to": "PATH: where results go; of an export, the kind of controller; of episodes, the format",
    "--multirun": "(or -m) run every combination of values that are separated by commas; anywhere on the line",
    "--config-dir": "FOLDER: choices of your own, such as FOLDER/experiment/mine.yaml",
    "--no-window": "play one episode without a page, and print how it ends",
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

FOLDERS = dict.fromkeys(("hydra.run.dir", "hydra.sweep.dir", "hydra.sweep.subdir"), False)
"""Keys of Hydra that hold paths, one each."""
PLAIN = re.compile(r"(?!(?:true|false|nan|inf)$)[A-Za-z/][\w/.-]*", re.IGNORECASE)
"""A path that Hydra's grammar reads as it stands."""
QUOTED = r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*\""""
ENTRY = re.compile(rf"\s*(?:{QUOTED}|\[[^\]]*\])\s*(?=,|$)|[^,]+")
"""What stands between commas that are in no quotes or brackets."""
SWEEP = re.compile(r"(?:choice|glob|range|interval|shuffle|sort|tag)\(.*\)")


LINE, SCREEN = 78, 22
"""Characters of a terminal's line, and its lines, that a message may fill."""


class UsageError(ValueError):
    """What is refused before any work: words or a configuration that make none; the message says what was expected."""


def one_screen(message: str) -> str:
    """A message of at most one screen: long lines without their middle, and only as many as there is room for."""
    lines = [
        line if len(line) <= 6 * LINE else f"{line[: 4 * LINE]} [...] {line[-LINE:]}" for line in message.splitlines()
    ]
    room, shown = SCREEN, list[str]()
    while lines and (room := room - max(1, -(-len(lines[0]) // LINE))) >= 1:
        shown.append(lines.pop(0))
    return "\n".join([*shown, *([f"... and {len(lines)} lines more."] if lines else [])])


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


def quoted(value: str) -> str:
    """A value that Hydra's grammar takes for one text, whatever is in it."""
    return "'" + re.sub(r"(\\*)('|$)", lambda found: 2 * found[1] + found[2].replace("'", "\\'"), value) + "'"


def as_path(value: str, lists: bool = False, many: bool = False) -> str:
    """A path as Hydra's grammar takes it, whatever is in its name; of a list, and of the choices of a multirun, each.

    Args:
        value: as given; what is in quotes stays as it is.
        lists: whether it may be a list, [a,b].
        many: whether commas separate choices.
    """
    if value in ("", "null") or PLAIN.fullmatch(value) or re.fullmatch(QUOTED, value):
        return value
    if many and SWEEP.fullmatch(value):
        return value
    entries = ENTRY.findall(value)
    if many and len(entries) > 1:
        return ",".join(as_path(entry.strip(), lists) for entry in entries)
    if lists and re.fullmatch(r"\[.*\]", value):
        return "[" + ",".join(as_path(entry.strip()) for entry in ENTRY.findall(value[1:-1])) + "]"
    return quoted(value)


def rewritten(
    override: str,
    groups: Collection[str],
    untouched: Collection[str],
    paths: Mapping[str, bool] = FOLDERS,
    many: bool = False,
) -> str:
    """An override as Hydra is to see it: any key may be set, since the schema judges the result.

    Paths and a list of player types are quoted, `sampler.<source>=0.2` means the source's share; `a.b=c` and `+a.b=c`
    become `++a.b=c`, `+group=choice` becomes `group=choice`.

    Args:
        override: as given.
        groups: those that the command composes.
        untouched: further keys, which stay as given.
        paths: keys that hold paths, and whether they may hold several.
        many: whether commas separate the choices of a multirun.
    """
    key, equals, value = override.partition("=")
    bare = key.lstrip("+").split("@")[0]
    if equals and bare in paths:
        value = as_path(value, paths[bare], many)
        override = f"{key}={value}"
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
