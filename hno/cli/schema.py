"""The schema of configurations: entries of given types, and registered parts with the options of their constructors."""

from __future__ import annotations

import inspect
import pkgutil
import re
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Annotated, Any, TypeVar, get_args, get_origin

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, create_model
from pydantic_core import PydanticCustomError

from hno.registry import Registry, options_of, unknown_name


class SettingsError(ValueError):
    """A configuration that makes no run; one line for every mistake."""


class Settings(BaseModel):
    """Entries of a configuration, each of the type that it says; others are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, protected_namespaces=())


S = TypeVar("S", bound=Settings)


def validated(model: type[S], content: Mapping[str, Any], given: Collection[str] = ()) -> S:
    """A configuration whose entries are all known and make sense.

    Args:
        model: the schema of the command.
        content: plain containers.
        given: keys that the command line names.

    Raises:
        SettingsError: with every mistake, what was expected and what came.
    """
    try:
        return model.model_validate(dict(content), context={"given": given})
    except ValidationError as error:
        raise SettingsError("\n".join(_sentence(model, found) for found in error.errors())) from error


def _sentence(model: type[Settings], found: Any) -> str:
    names = [str(part) for part in found["loc"]]
    key, cause = ".".join(names), found.get("ctx", {}).get("error")
    if isinstance(cause, SettingsError):  # of the options of a registered part
        return "\n".join(f"{key}.{line}" for line in str(cause).splitlines())
    if found["type"] == "extra_forbidden":
        for name in names[:-1]:
            nested = model.model_fields[name].annotation
            model = (get_args(nested) or (nested,))[0]  # without "| None"
        return f"{key} does not exist. {unknown_name('configuration key', names[-1], sorted(model.model_fields))}"
    if found["type"] == "missing":
        return f"{key} is missing: give it as {key}=<value>; --help says more."
    expected = re.sub(r"^\w+ should", "must", found["msg"].partition(" or instance of ")[0])
    return f"{key}: {cause}" if cause else f"{key} {expected}; got {found['input']!r}."


def places(model: type[BaseModel], above: str = "") -> dict[str, bool]:
    """Keys of a schema that hold a `Place`, and whether they may hold several."""
    found: dict[str, bool] = {}
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            found |= places(field.annotation, f"{above}{name}.")
        elif "path" in field.metadata or Place in get_args(field.annotation):
            found[above + name] = get_origin(field.annotation) is list
    return found


def _loose(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, (int, float, str, list)):
        raise PydanticCustomError("loose", "Input should be a number, text or a list")
    return value


Size = Annotated[int, Field(ge=1)]
Count = Annotated[int, Field(ge=0)]
Seed = Annotated[int, Field(ge=0, le=2**32 - 1)]
Positive = Annotated[float, Field(gt=0)]
Amount = Annotated[float, Field(ge=0)]
Probability = Annotated[float, Field(gt=0, lt=1)]
"""Neither 0 nor 1."""
Share = Annotated[float, Field(ge=0, le=1)]
Text = Annotated[str, Field(min_length=1)]
Place = Annotated[str, Field(min_length=1), "path"]
"""A path."""
Loose = Annotated[Any, AfterValidator(_loose)]
"""What Lightning judges, or `hno.games.grid.parse_types`."""
REGISTRIES: Mapping[str, Callable[[], Registry[Any]]] = {
    kind: partial(pkgutil.resolve_name, place)
    for kind, place in {
        "game": "hno.games:games",
        "function": "hno.operators:functions",
        "network": "hno.operators:networks",
        "activation": "hno.operators:activations",
        "loss": "hno.losses:losses",
        "source": "hno.data.sources:sources",
        "optimizer": "hno.training.optimizers:optimizers",
        "callback": "hno.training.callbacks:callbacks",
    }.items()
}
"""The registry of every kind, as a function that imports it."""
GIVEN = {
    "function": ("game", "network"),
    "network": ("inputs", "activation"),
    "optimizer": ("params", "parameters", "lr"),
}
"""Arguments of constructors that the package passes: they are no options."""
SHARED = ("exact_terminal", "members")
"""Options of a function that files of games and of the choice `auto` set."""
SCHEDULE: Mapping[str, Any] = {"lr": (Positive, ...), "schedule": (str, ...), "final_lr": (Positive, ...)}
"""Entries of an optimiser that belong to the schedule of its rate."""


def _schema(kind: str, name: object, also: Mapping[str, Any]) -> type[Settings]:
    """The schema of a registered name: each option has the type of its default."""
    try:
        factory = REGISTRIES[kind]().get(str(name))
    except LookupError as error:
        raise ValueError(str(error)) from error
    annotations = {key: parameter.annotation for key, parameter in inspect.signature(factory).parameters.items()}
    fields: dict[str, Any] = {}
    for key, default in options_of(factory, skip=GIVEN.get(kind, ())).items():
        whole = type(default) is int and annotations[key] not in (float, "float")  # torch writes 0 for 0.0
        known = int if whole else {bool: bool, int: float, float: float, str: str}.get(type(default), Any)
        fields[key] = (known, ... if default is inspect.Parameter.empty else default)
    return create_model(str(name), __base__=Settings, **fields, **also)


def _part(kind: str, also: Mapping[str, Any] = {}) -> AfterValidator:  # it is read only
    """A registered name with some of its options."""

    def check(content: dict[str, Any]) -> dict[str, Any]:
        schema = _schema(kind, content.get("name"), {"name": (str, ...), **also})
        return validated(schema, content).model_dump(exclude_unset=True)

    return AfterValidator(check)


def _several(kind: str, also: Mapping[str, Any] = {}) -> AfterValidator:  # it is read only
    """Options by registered name, all of them; null removes one."""

    def check(content: dict[str, Any]) -> dict[str, dict[str, Any]]:
        schemas: dict[str, Any] = {
            name: (_schema(kind, name, also) | None, None) for name in REGISTRIES[kind]().names()
        }
        found = validated(create_model(kind, __base__=Settings, **schemas), content).model_dump()
        return {name: found[name] for name in content if found[name] is not None}

    return AfterValidator(check)


def _function(content: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
    """A registered function and all of its options; `auto` is the potential where the game has one.

    Files of games set `SHARED` options; a function that does not know them is not given them.
    """
    if content.get("name") == AUTO:
        chosen = info.data.get("game")  # none where the game itself is refused
        content = {**content, "name": "potential" if chosen is not None and chosen.potential else "value"}
    schema = _schema("function", content.get("name"), {"name": (str, ...)})
    given = {key for key in SHARED if f"function.{key}" in (info.context or {}).get("given", ())}
    dropped = set(SHARED) - schema.model_fields.keys() - given
    return validated(schema, {k: v for k, v in content.items() if k not in dropped}).model_dump()


AUTO = "auto"
"""The name of the function that follows the game."""
Function = Annotated[dict[str, Any], AfterValidator(_function)]
Network = Annotated[dict[str, Any], _part("network")]
Activation = Annotated[dict[str, Any], _part("activation")]
Optimizer = Annotated[dict[str, Any], _part("optimizer", SCHEDULE)]
Sampler = Annotated[dict[str, Any], _several("source", {"share": (Amount, ...)})]
Callbacks = Annotated[dict[str, Any], _several("callback")]
Terms = Annotated[dict[str, Any], _several("loss")]
Weights = Annotated[
    dict[str, Amount | None], AfterValidator(lambda found: {k: v for k, v in found.items() if v is not None})
]
