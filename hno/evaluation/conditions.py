"""Conditions of play: where episodes begin, and what disturbs them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from hno.control.belief import ACTS
from hno.control.disturbance import Disturbance, pushed_states
from hno.games import Game
from hno.registry import unknown_name

TIES = 25
"""Ties that are played per type, at most: finding one takes some twenty labels."""


class Condition(NamedTuple):
    """Where episodes begin, and what disturbs them."""

    name: str = ""
    widen: float = 1.0
    """Width of the start box in units of the game's."""
    symmetric: bool = False
    """Whether all players start in the same own state."""
    ties: bool = False
    """Whether the two cheapest equilibria of every start cost nearly the same, see `hno.data.ties`."""
    disturbance: Disturbance = Disturbance()

    @property
    def starts(self) -> tuple[float, bool, bool]:
        """What its start states depend on."""
        return self.widen, self.symmetric, self.ties

    def entries(self) -> dict[str, Any]:
        """What differs from undisturbed episodes in the game's own start box, by the names of `ENTRIES`."""
        here, usual = (condition._asdict() | condition.disturbance._asdict() for condition in (self, Condition()))
        return {entry: here[entry] for entry in ENTRIES if here[entry] != usual[entry]}


def _amount(value: Any) -> bool:
    return type(value) in (int, float) and 0 <= value < math.inf


_AMOUNT = "a finite number of at least 0", _amount
ENTRIES: Mapping[str, tuple[str, Callable[[Any], bool]]] = {
    "widen": ("a positive number", lambda value: _amount(value) and value > 0),
    "symmetric": ("true or false", lambda value: isinstance(value, bool)),
    "ties": ("true or false", lambda value: isinstance(value, bool)),
    "noise": _AMOUNT,
    "delay": ("a whole number of at least 0", lambda value: type(value) is int and value >= 0),
    "drift": _AMOUNT,
    "gusts": _AMOUNT,
    "components": (
        "a list of places in a player's state, or null",
        lambda value: value is None or (isinstance(value, Sequence) and all(type(place) is int for place in value)),
    ),
    "belief": _AMOUNT,
    "learns": (f"{', '.join(ACTS)} or null", lambda value: value is None or value in ACTS),
}
"""What a configuration may say of a condition: what each entry must be, in words and as a test."""


def table_condition(game: Game, settings: Mapping[str, Any]) -> Condition:
    """The condition of the collision table, from the entries of a configuration. Raises as `read_condition`."""
    entries = {entry: settings[entry] for entry in ENTRIES if entry in settings}
    return read_condition(game, entries, Condition(disturbance=Disturbance(seed=settings["seed"])))


def read_conditions(game: Game, content: object, base: Condition) -> list[Condition]:
    """Conditions from a configuration: name -> entries that replace those of the base.

    Raises:
        ValueError: no conditions, or as `read_condition`.
    """
    if not (isinstance(content, Mapping) and content):
        raise ValueError(f"conditions must be names with entries such as {{noise: {{noise: 0.2}}}}; got {content!r}.")
    for name, entries in content.items():
        if not isinstance(entries, Mapping):
            raise ValueError(f"conditions.{name} must be entries such as {{noise: 0.2}}; got {entries!r}.")
    return [
        read_condition(game, entries, base._replace(name=str(name)), f"conditions.{name}.")
        for name, entries in content.items()
    ]


def read_condition(game: Game, entries: Mapping[Any, Any], base: Condition, place: str = "") -> Condition:
    """A condition whose entries replace those of the base; `place` says in messages where they stand.

    Raises:
        ValueError: an entry that does not exist, or a number that makes no sense.
    """
    for entry, value in entries.items():
        if entry not in ENTRIES:
            raise ValueError(f"{place}{entry} does not exist. {unknown_name('condition entry', entry, list(ENTRIES))}")
        wanted, met = ENTRIES[entry]
        if not met(value):
            raise ValueError(f"{place}{entry} must be {wanted}; got {value!r}.")
    pushed_states(game, entries.get("components"))
    chosen: dict[str, Any] = {
        name: tuple(value) if isinstance(value, Sequence) and name != "learns" else value
        for name, value in entries.items()
    }
    own: dict[str, Any] = {name: chosen.pop(name) for name in Condition._fields if name in chosen}
    disturbance = base.disturbance._replace(**chosen)
    if disturbance.learns and disturbance.belief:
        raise ValueError(
            f"{place}learns and {place}belief exclude each other: who learns types is not wrong throughout."
        )
    return base._replace(**own, disturbance=disturbance)
