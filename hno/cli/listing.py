"""`hno list`: what is registered, and where it comes from."""

from __future__ import annotations

import sys
import warnings

from hno.cli.arguments import Arguments, UsageError
from hno.cli.config import choices, config_dir
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


def run(given: Arguments) -> int:
    """`hno list [KIND ...]`: all kinds by default, in the singular or plural."""
    names = {form: kind for kind in KINDS for form in (kind, plural(kind))}
    unknown = [word for word in given.words if word not in names]
    if unknown:
        raise UsageError(unknown_name("kind", unknown[0], list(KINDS)))
    failed = dict[str, str]()
    for kind in dict.fromkeys(names[word] for word in given.words or KINDS):
        print(f"{plural(kind)} ({ABOUT.get(kind, f'{kind}=NAME')})")
        for row in _methods() if kind == "method" else _registered(kind, failed):
            print(f"  {row.name:<14}{row.summary}  [{row.origin}]")
        print()
    for what, why in failed.items():
        print(f"Could not be loaded: {what}: {why}", file=sys.stderr)
    return 1 if failed else 0


def _registered(kind: str, failed: dict[str, str]) -> list[Description]:
    with warnings.catch_warnings(action="ignore"):  # what cannot be loaded is said at the end
        registry = REGISTRIES[kind]()
        found = [registry.describe(name) for name in registry.names()]
    failed.update(registry.broken)
    return found


def _methods() -> list[Description]:
    files = [(name, path) for name, path in choices("operator").items() if path is not None]
    places = [path.parent.parent for _, path in files]  # conf of ours, or of a package
    origins = ["hno" if place == config_dir() else place.parent.name for place in places]
    return [Description(name, heading(path), origin) for (name, path), origin in zip(files, origins, strict=True)]
