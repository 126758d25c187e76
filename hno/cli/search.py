"""The words of `hno tune` beside those of a training: how many trials, who proposes them, and where they are kept."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self
from urllib.parse import urlsplit

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from pydantic import ConfigDict, model_validator

from hno.cli.arguments import UsageError
from hno.cli.schema import Seed, Settings, SettingsError, Size, Text, validated
from hno.report.runs import read_json

STUDY, DATABASE = "study.json", "study.db"
"""Names in the folder of a search: what came of its trials, for readers; and where Optuna keeps them, by default."""


class Named(Settings):
    """Something by its name; the rest are its options, numbers and switches."""

    model_config = ConfigDict(extra="allow")

    name: Text

    @model_validator(mode="after")
    def _numbers(self) -> Self:
        for key, value in self.options.items():
            if not isinstance(value, (bool, int, float)):
                raise SettingsError(f"{key} must be a number, true or false; got {value!r}.")
        return self

    @property
    def options(self) -> dict[str, Any]:
        """All but the name and the seed."""
        return self.model_extra or {}


class Proposer(Named):
    """Who proposes trials."""

    seed: Seed = 0


class Search(Settings):
    """How a search goes on."""

    trials: Size = 20
    """Of the whole study, whatever became of them."""
    at_once: Size | None = None
    """Trials that are launched together; by default as many as the launcher runs at once."""
    search: Proposer = Proposer(name="tpe")
    pruner: Named | None = None
    storage: Text | None = None
    """URL of a database; None for a file in the folder of the search."""
    study: Text = "hno"
    """Its name there."""

    def words(self) -> Iterator[str]:
        """As the command line says it, without what is so by default."""
        for key, value in self.model_dump(exclude_defaults=True).items():
            if isinstance(value, dict):
                yield f"{key}={value.pop('name')}"
                yield from (f"{key}.{option}={one}" for option, one in value.items())
            else:
                yield f"{key}={value}"


def taken(overrides: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """The words of a search as a mapping for `Search`, and the other words.

    Raises:
        UsageError: a value that cannot be read.
    """
    found, rest = dict[str, Any](), list[str]()
    for override in overrides:
        key, _, value = override.partition("=")
        whole, _, option = key.lstrip("+").partition(".")
        if whole not in Search.model_fields:
            rest.append(override)
        elif option:
            found.setdefault(whole, {"name": "tpe"} if whole == "search" else {})[option] = _value(override)
        elif whole in ("search", "pruner"):
            found[whole] = None if value in ("", "null", "none") else {**(found.get(whole) or {}), "name": value}
        else:
            found[whole] = value.strip("'\"") if whole in ("storage", "study") else _value(override)
    return found, rest


def _value(word: str) -> Any:
    try:
        return OverridesParser.create().parse_override(word).value()
    except HydraException as error:
        raise UsageError(f"{word} cannot be read: {str(error).splitlines()[0]}.") from error


def judged(content: Mapping[str, Any]) -> Search:
    """A search that makes sense.

    Raises:
        UsageError: with what does not.
    """
    try:
        search = validated(Search, content)
    except SettingsError as error:
        raise UsageError(str(error)) from error
    if search.storage is None:
        if "study" in content and content["study"] != Search().study:
            raise UsageError("study= names a study in a database: give storage=<its URL> too, or leave it out.")
        return search
    if "study" not in content:
        raise UsageError("storage= holds the studies of many: name yours with study=<name>.")
    try:
        secret = urlsplit(search.storage).password
    except ValueError:
        secret = None
    if secret is not None:
        raise UsageError(
            "storage= with a password would leave it in files and in the list of processes. Leave it out of the URL; "
            "Postgres takes it from ~/.pgpass or $PGPASSWORD."
        )
    return search


def before(folder: Path) -> dict[str, Any]:
    """What the folder of a search says of it.

    Raises:
        UsageError: it is none.
    """
    try:
        content = read_json(folder / STUDY)
        if not (isinstance(content.get("mark"), str) and isinstance(content.get("search"), dict)):
            raise ValueError("it says nothing of the search")
        return content
    except ValueError as error:
        raise UsageError(
            f"There is no search to go on with in {folder}: {error}. sweep=<folder> takes the folder of an earlier "
            "`hno tune`, such as multirun/<date>/<time>."
        ) from error


def same_place(said: Mapping[str, Any], words: Mapping[str, Any]) -> dict[str, Any]:
    """What the folder of a search says of it, for a search that goes on where its trials are kept.

    Raises:
        UsageError: that is a database and is not named again: a folder may be from somebody else, and a file of it is
            not to choose what is opened; or another place is named.
    """
    was = judged({key: value for key, value in said.items() if said.get("storage") or key != "study"})
    if was.storage is None:
        if moved := [key for key in ("storage", "study") if key in words and words[key] != getattr(was, key)]:
            raise UsageError(f"A search goes on with the study that it has: leave {moved[0]}= out.")
        return was.model_dump(exclude={"storage", "study"})
    if (words.get("storage"), words.get("study")) != (was.storage, was.study):
        raise UsageError(
            f"This search keeps its trials in a database, and its address is not taken from a file, which may be "
            f"somebody else's. If you know it, give it again: storage={was.storage} study={was.study}"
        )
    return was.model_dump()
