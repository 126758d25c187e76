"""`hno list`: what is registered, and where it comes from."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

from hno.cli.arguments import Arguments, UsageError
from hno.cli.config import choices, config_dir
from hno.cli.help import heading
from hno.cli.kinds import REGISTRIES
from hno.registry import Description, plural, unknown_name

KINDS = ("game", "method", "operator", "network", "activation", "loss", "source", "optimizer")
ABOUT = {
    "method": "operator=NAME: loss terms, weights and the function that is trained",
    "operator": "operator.function=NAME",
    "loss": "loss.terms.NAME={...} and loss.weights.NAME",
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
        rows = list(_methods() if kind == "method" else _registered(kind, failed))
        for row in rows:
            print(f"  {row.name:<14}{row.summary}  [{row.origin}]")
        print()
    for what, why in failed.items():
        print(f"Could not be loaded: {what}: {why}", file=sys.stderr)
    return 1 if failed else 0


def _registered(kind: str, failed: dict[str, str]) -> Iterator[Description]:
    with warnings.catch_warnings(action="ignore"):  # what cannot be loaded is said at the end
        registry = REGISTRIES[kind]()
        found = [registry.describe(name) for name in registry.names()]
    failed.update(registry.broken)
    yield from found


def _methods() -> Iterator[Description]:
    for name, path in choices("operator").items():
        if path is not None:
            yield Description(name, heading(path), _owner(path))


def _owner(path: Path) -> str:
    folder = path.parent.parent
    return "hno" if folder == config_dir() else folder.parent.name
