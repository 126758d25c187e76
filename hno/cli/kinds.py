"""What can be registered, by kind. A registry is imported when it is asked for."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from hno.registry import Registry

PLACES = {
    "game": "hno.games:games",
    "operator": "hno.operators:operators",
    "network": "hno.operators:networks",
    "activation": "hno.operators:activations",
    "loss": "hno.losses:losses",
    "source": "hno.data.sources:sources",
    "optimizer": "hno.training.optimizers:optimizers",
}

REGISTRIES: Mapping[str, Callable[[], Registry[Any]]] = {
    kind: partial(pkgutil.resolve_name, place) for kind, place in PLACES.items()
}
"""The registry of every kind, as a function that imports it."""

GIVEN = {
    "operator": ("game", "network"),
    "network": ("inputs", "activation"),
    "optimizer": ("params", "parameters", "lr"),
}
"""Arguments of constructors that the package passes: they are no options."""
