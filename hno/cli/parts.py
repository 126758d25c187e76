"""Registered parts in a configuration: names that are known, with options that their constructors take."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping
from typing import Any

from pydantic import PlainValidator, ValidationInfo

from hno.cli.entries import number
from hno.cli.kinds import GIVEN, REGISTRIES
from hno.registry import check_options, options_of

SHARED = ("exact_terminal", "members")
"""Options of an operator that files of games and methods set."""
SCHEDULE = ("lr", "schedule", "final_lr")
"""Entries of an optimiser that belong to the schedule of its rate."""


def checked(kind: str, name: object, given: object) -> dict[str, Any]:
    """Options of a registered name, with its defaults for those that are not given.

    Raises:
        ValueError: it or an option is unknown, or an option is of another type than its default.
    """
    given = given if isinstance(given, Mapping) else {}
    try:
        factory, skip = REGISTRIES[kind]().get(str(name)), GIVEN.get(kind, ())
        check_options(f"{kind} {name}", factory, given, skip=skip)
    except LookupError as error:
        raise ValueError(f": {error}") from error
    options = options_of(factory, skip=skip) | {str(key): value for key, value in given.items()}
    signature = inspect.signature(factory).parameters
    for key, default in options_of(factory, skip=skip).items():
        if options[key] is inspect.Parameter.empty:
            raise ValueError(f".{key} is missing: {kind} {name} has no default for it.")
        whole = type(default) is int and signature[key].annotation in (float, "float")  # torch writes 0 for 0.0
        expected, met = _LIKE.get(float if whole else type(default), ("", lambda value: True))
        if not met(options[key]):
            raise ValueError(f".{key} must be {expected}; got {options[key]!r}.")
    return options


_LIKE: Mapping[type, tuple[str, Callable[[Any], bool]]] = {
    bool: ("true or false", lambda value: isinstance(value, bool)),
    int: ("a whole number", lambda value: type(value) is int),
    float: ("a finite number", number),
    str: ("text", lambda value: isinstance(value, str)),
}
"""What an option must be, by the type of its default."""


def part(kind: str) -> PlainValidator:
    """A registered name with its options."""

    def check(content: Any) -> dict[str, Any]:
        found = mapping(content, ("name",))
        checked(kind, found["name"], {key: value for key, value in found.items() if key != "name"})
        return found

    return PlainValidator(check)


def optimizer(content: Any) -> dict[str, Any]:
    """A registered optimiser with its options, and the schedule of its learning rate."""
    found = mapping(content, ("name", *SCHEDULE))
    for key in ("lr", "final_lr"):
        if not (type(found[key]) in (int, float) and found[key] > 0):
            raise ValueError(f".{key} must be a positive number; got {found[key]!r}.")
    checked("optimizer", found["name"], {key: value for key, value in found.items() if key not in ("name", *SCHEDULE)})
    return found


def mapping(content: Any, needed: Collection[str] = ()) -> dict[str, Any]:
    """A mapping that has some entries."""
    if not isinstance(content, Mapping) or not set(needed) <= content.keys():
        entries = f" with {' and '.join(needed)}" if needed else ""
        raise ValueError(f" must be a mapping{entries}; got {content!r}.")
    return {str(key): value for key, value in content.items()}


def operator(content: Any, info: ValidationInfo) -> dict[str, Any]:
    """A method's name, its registered function and that function's options.

    Files of games and methods set `SHARED` options; a function that does not know them is not given them.
    """
    options = mapping(content, ("name", "function"))
    name, function = options.pop("name"), options.pop("function")
    given = (info.context or {}).get("given", ())
    registry = REGISTRIES["operator"]()
    if function in registry.names():
        known = options_of(registry.get(function), skip=GIVEN["operator"])
        options = {k: v for k, v in options.items() if k in known or k not in SHARED or f"operator.{k}" in given}
    return {"name": name, "function": function, **checked("operator", function, options)}


def terms(content: Any) -> dict[str, dict[str, Any]]:
    """Loss terms and all their options; null removes one."""
    return {
        name: checked("loss", name, mapping(given)) for name, given in mapping(content).items() if given is not None
    }


def weights(content: Any) -> dict[str, float]:
    """Weights; null removes one."""
    found = {name: weight for name, weight in mapping(content).items() if weight is not None}
    for name, weight in found.items():
        if not (number(weight) and weight >= 0):
            raise ValueError(f".{name} must be a finite number of at least 0; got {weight!r}.")
    return found


def sampler(content: Any) -> dict[str, dict[str, Any]]:
    """Shares of sources, and all their options; null removes one."""
    found = {}
    for name, entry in mapping(content).items():
        options = mapping({"share": entry} if not isinstance(entry, Mapping) else entry)
        share = options.pop("share", None)
        if not (number(share) and share >= 0) and entry is not None:
            raise ValueError(f".{name} must have a share, a finite number of at least 0; got {entry!r}.")
        if entry is not None:
            found[name] = {"share": share, **checked("source", name, options)}
    return found
