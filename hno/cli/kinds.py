"""What can be registered, by kind; a registry is imported when it is asked for."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from hno.registry import Registry

PLACES = {
    "game": "hno.games:games",
    "activation": "hno.operators:activations",
    "loss": "hno.losses:losses",
}

REGISTRIES: Mapping[str, Callable[[], Registry[Any]]] = {
    kind: partial(pkgutil.resolve_name, place) for kind, place in PLACES.items()
}
"""The registry of every kind, as a function that imports it."""
