"""Conditions of play: where episodes begin, and what disturbs them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from hno.control.disturbance import Disturbance, pushed_states
from hno.games import Game
from hno.registry import unknown_name


class Condition(NamedTuple):
    """Where episodes begin, and what disturbs them."""

    name: str = ""
    """Of the condition."""
    widen: float = 1.0
    """Width of the start box in units of the game's."""
    symmetric: bool = False
    """Whether all players start in the same own state."""
    disturbance: Disturbance = Disturbance()
    """Of the episodes."""

    @property
    def starts(self) -> tuple[float, bool]:
        """What its start states depend on."""
        return self.widen, self.symmetric

    def entries(self) -> dict[str, Any]:
        """What differs from undisturbed episodes in the game's own start box, by the names of `ENTRIES`."""
        here, usual = _flat(self), _flat(Condition())
        return {entry: here[entry] for entry in ENTRIES if here[entry] != usual[entry]}


def _flat(condition: Condition) -> dict[str, Any]:
    return {"widen": condition.widen, "symmetric": condition.symmetric} | condition.disturbance._asdict()


ENTRIES = tuple(entry for entry in _flat(Condition()) if entry != "seed")
"""What a configuration may say of a condition."""


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
    """A condition from a configuration.

    Args:
        game: the game.
        entries: what replaces the entries of the base, by the names of `ENTRIES`.
        base: all other entries.
        place: where the entries stand, for messages.

    Raises:
        ValueError: an entry that does not exist, or a number that makes no sense.
    """
    for entry, value in entries.items():
        _check(place, entry, value)
    pushed_states(game, entries.get("components"))
    chosen: dict[str, Any] = {
        name: tuple(value) if isinstance(value, Sequence) else value for name, value in entries.items()
    }
    own: dict[str, Any] = {name: chosen.pop(name) for name in ("widen", "symmetric") if name in chosen}
    return base._replace(**own, disturbance=base.disturbance._replace(**chosen))


def _check(place: str, entry: str, value: object) -> None:
    """Raise ValueError unless a value fits an entry, by the type of the entry's default."""
    if entry not in ENTRIES:
        raise ValueError(f"{place}{entry} does not exist. {unknown_name('condition entry', entry, list(ENTRIES))}")
    kind, number = type(_flat(Condition())[entry]), type(value) in (int, float)
    if entry == "components":
        valid = value is None or (isinstance(value, Sequence) and all(type(place) is int for place in value))
        wanted = "a list of places in a player's state, or null"
    elif kind is bool:
        valid, wanted = isinstance(value, bool), "true or false"
    elif kind is int:
        valid, wanted = type(value) is int and value >= 0, "a whole number of at least 0"
    else:
        valid, wanted = number and 0 <= value < math.inf, "a finite number of at least 0"  # type: ignore[operator]
        if entry == "widen":
            valid, wanted = valid and value != 0, "a positive number"
    if not valid:
        raise ValueError(f"{place}{entry} must be {wanted}; got {value!r}.")
