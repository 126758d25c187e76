"""`hno list`: what is registered or can be chosen, and where it comes from."""

from __future__ import annotations

import sys
import warnings

from hno.cli.arguments import Arguments, UsageError
from hno.cli.confs import CHOSEN, Folders, files, groups, hidden
from hno.cli.help import heading
from hno.cli.schema import REGISTRIES
from hno.registry import Description, plural, unknown_name

KINDS = ("game", "method", "function", "network", "activation", "loss", "source", "optimizer", "callback")
ABOUT = {
    "method": "operator=NAME: loss terms and their weights",
    "function": "function=NAME: what is learned; auto is the potential where the game has one",
    "loss": "loss.terms.NAME={...} and loss.weights.NAME",
    "callback": "callbacks.NAME={...}",
    "source": "sampler.NAME.share, of collocation points",
}
"""How a kind is chosen, where it is not <kind>=NAME."""
FILES = {"method": "operator"}
"""Groups of kinds that are files."""
OTHERWISE = ("operator", "loss", "callbacks")
"""Groups whose choices are listed as a kind: methods, terms, callbacks."""


def run(given: Arguments) -> int:
    """`hno list [KIND ...]`: all kinds and groups of choices by default; kinds in the singular or plural."""
    others = [group for group in groups("train") if group not in (*KINDS, *OTHERWISE)]
    names = {form: kind for kind in KINDS for form in (kind, plural(kind))} | {group: group for group in others}
    unknown = [word for word in given.words if word not in names]
    if unknown:
        raise UsageError(unknown_name("kind", unknown[0], [*KINDS, *others]))
    failed = Folders.broken()
    failed |= {f"{path} of {origin}": f"a file of {first} has its name and counts" for path, origin, first in hidden()}
    for kind in dict.fromkeys(names[word] for word in given.words or (*KINDS, *others)):
        print(f"{plural(kind) if kind in KINDS else kind} ({ABOUT.get(kind, f'{kind}=NAME')})")
        for row in _registered(kind, failed) if kind in REGISTRIES else _files(FILES.get(kind, kind)):
            print(f"  {row.name:<14} {row.summary}  [{row.origin}]")
        print()
    for what, why in failed.items():
        print(f"Could not be loaded: {what}: {why}", file=sys.stderr)
    return 1 if failed else 0


def _registered(kind: str, failed: dict[str, str]) -> list[Description]:
    """Registered names, and choices by file alone; a file of another package than its class is said."""
    with warnings.catch_warnings(action="ignore"):  # what cannot be loaded is said at the end
        registry = REGISTRIES[kind]()
        found = {name: registry.describe(name) for name in registry.names()}
    failed.update(registry.broken)
    for row in _files(kind) if kind in CHOSEN else ():
        known = found.setdefault(row.name, row)
        if known.origin != row.origin:
            found[row.name] = known._replace(origin=f"{known.origin}; its file: {row.origin}")
    return [found[name] for name in sorted(found)]


def _files(group: str) -> list[Description]:
    return [Description(name, heading(path), origin) for name, (path, origin) in sorted(files(group).items())]
