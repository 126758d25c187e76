"""What configurations may hold: one schema for every command."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from typing import Annotated, Any, TypeVar, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import PydanticCustomError

from hno.registry import unknown_name


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


def _loose(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, (int, float, str, list)):
        raise PydanticCustomError("loose", "Input should be a number, text or a list")
    return value


Size = Annotated[int, Field(ge=1)]
Count = Annotated[int, Field(ge=0)]
Seed = Annotated[int, Field(ge=0, le=2**32 - 1)]
Positive = Annotated[float, Field(gt=0)]
Amount = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Text = Annotated[str, Field(min_length=1)]
Loose = Annotated[Any, AfterValidator(_loose)]
"""What Lightning judges, or `hno.games.grid.parse_types`."""
