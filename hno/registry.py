"""Names for classes: a decorator, discovery on first use, and errors that help."""

from __future__ import annotations

import difflib
import importlib
import inspect
import pkgutil
from collections.abc import Callable, Collection
from importlib.metadata import entry_points
from typing import Any, Generic, TypeVar

T = TypeVar("T")


class UnknownNameError(KeyError):
    """A name that no class is registered under."""

    def __str__(self) -> str:
        """The message without the quotes that KeyError adds."""
        return str(self.args[0])


class Registry(Generic[T]):
    """A mapping from names to classes of one kind.

    The modules of `package` and the entry points of group `hno.<kind>s` are imported on the first look-up, so a plugin
    costs nothing until it is asked for.

    Args:
        kind: what the classes are, in the singular ("game"); it appears in errors and names the entry-point group.
        package: the package whose modules register classes, e.g. "hno.games".
    """

    def __init__(self, kind: str, package: str) -> None:
        self.kind = kind
        self.package = package
        self._classes: dict[str, type[T]] = {}
        self._discovered = False

    def register(self, name: str) -> Callable[[type[T]], type[T]]:
        """Class decorator that files the class under `name`.

        Raises:
            ValueError: another class already has that name.
        """

        def decorate(cls: type[T]) -> type[T]:
            known = self._classes.get(name)
            if known is not None and (known.__module__, known.__qualname__) != (cls.__module__, cls.__qualname__):
                raise ValueError(
                    f"The {self.kind} name {name!r} is taken by {known.__module__}.{known.__qualname__}. "
                    f"Register {cls.__module__}.{cls.__qualname__} under another name."
                )
            self._classes[name] = cls
            return cls

        return decorate

    def names(self) -> list[str]:
        """Every registered name, sorted."""
        self._discover()
        return sorted(self._classes)

    def get(self, name: str) -> type[T]:
        """The class filed under `name`.

        Raises:
            UnknownNameError: no such name; the message lists the known ones and the nearest.
        """
        self._discover()
        if name not in self._classes:
            raise UnknownNameError(unknown_name(self.kind, name, self.names()))
        return self._classes[name]

    def name_of(self, cls: type[T]) -> str:
        """The name a class is filed under.

        Raises:
            UnknownNameError: it is not registered.
        """
        for name in self.names():
            if self._classes[name] is cls:
                return name
        raise UnknownNameError(f"{cls.__qualname__} is not a registered {self.kind}. Known: {', '.join(self.names())}.")

    def _discover(self) -> None:
        if self._discovered:
            return
        package = importlib.import_module(self.package)
        for module in pkgutil.iter_modules(package.__path__):
            importlib.import_module(f"{self.package}.{module.name}")
        for point in entry_points(group=f"hno.{self.kind}s"):
            self.register(point.name)(point.load())
        self._discovered = True


def unknown_name(kind: str, name: str, known: list[str]) -> str:
    """The message for a name that is not among the known ones."""
    near = difflib.get_close_matches(name, known, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return f"No {kind} named {name!r}. Known: {', '.join(known)}.{hint}"


def options_of(factory: Callable[..., Any], *, skip: Collection[str] = ()) -> dict[str, Any]:
    """Options of a class or function and their defaults; `inspect.Parameter.empty` for those without one.

    Args:
        factory: the class or function.
        skip: parameters that are no options.
    """
    kinds = inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD
    parameters = inspect.signature(factory).parameters.values()
    return {p.name: p.default for p in parameters if p.kind not in kinds and p.name not in skip}


def check_options(
    what: str, factory: Callable[..., Any], given: Collection[str], *, skip: Collection[str] = ()
) -> None:
    """Refuse options that a class or function does not know.

    Args:
        what: it, in words.
        factory: the class or function.
        given: names of options.
        skip: parameters that are no options.

    Raises:
        UnknownNameError: one of them is unknown; the message lists the known ones and the nearest.
    """
    known = sorted(options_of(factory, skip=skip))
    for name in given:
        if name not in known:
            raise UnknownNameError(unknown_name(f"option of {what}", name, known or ["none"]))
