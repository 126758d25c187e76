"""Names for classes and functions: a decorator, discovery on first use, and errors that help."""

from __future__ import annotations

import difflib
import importlib
import inspect
import pkgutil
import traceback
import warnings
from collections.abc import Callable, Collection
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, NamedTuple, TypeVar

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])


class UnknownNameError(KeyError):
    """A name that nothing is registered under."""

    def __str__(self) -> str:
        """The message without the quotes that KeyError adds."""
        return str(self.args[0])


class BrokenPluginWarning(UserWarning):
    """A module or an entry point that could not be loaded."""


class Description(NamedTuple):
    """What a registered name stands for."""

    name: str
    summary: str
    """First line of the docstring."""
    origin: str
    """Distribution and version that it comes from, or its module where no distribution offers it."""


class Registry(Generic[T]):
    """A mapping from names to classes of one kind, or to functions that build such objects.

    The modules of `package` and the entry points of the group `hno.<kinds>` are imported on the first look-up, so a
    plugin costs nothing until it is asked for. What cannot be imported is left out with a warning, see `broken`.

    Args:
        kind: what the classes are, in the singular ("game"); it appears in errors.
        package: the package whose modules register classes, e.g. "hno.games".
        base: where the class lies that registered classes must extend, "module:name", if they must.
    """

    def __init__(self, kind: str, package: str, base: str | None = None) -> None:
        self.kind = kind
        self.package = package
        self.base = base
        self.group = f"hno.{plural(kind)}"
        self.broken: dict[str, str] = {}
        """What could not be loaded, and why: "ModuleNotFoundError: ... (file:line)"."""
        self._classes: dict[str, type[T]] = {}
        self._origins: dict[str, str] = {}
        self._discovered = False

    def register(self, name: str) -> Callable[[F], F]:
        """Decorator that files a class, or a function that builds an object, under `name`.

        Raises:
            ValueError: another class already has that name.
            TypeError: neither a function nor a class of this kind.
        """

        def decorate(cls: F) -> F:
            if not callable(cls):
                raise TypeError(f"A {self.kind} must be a class or a function that builds one; got {cls!r}.")
            if self.base is not None and isinstance(cls, type):
                base = pkgutil.resolve_name(self.base)
                if not issubclass(cls, base):
                    raise TypeError(f"A {self.kind} must extend {_place(base)}; {_place(cls)} does not.")
            known = self._classes.get(name)
            if known is not None and _place(known) != _place(cls):
                raise ValueError(
                    f"The {self.kind} name {name!r} is taken by {_place(known)}. "
                    f"Register {_place(cls)} under another name."
                )
            self._classes[name] = cls  # type: ignore[assignment]  # a function is called as a class is
            return cls

        return decorate

    def names(self) -> list[str]:
        """Every registered name, sorted."""
        self._discover()
        return sorted(self._classes)

    def get(self, name: str) -> type[T]:
        """The class or function filed under `name`.

        Raises:
            UnknownNameError: no such name; the message lists the known ones, the nearest and what could not be loaded.
        """
        self._discover()
        if name not in self._classes:
            raise UnknownNameError(self.unknown(name))
        return self._classes[name]

    def unknown(self, name: str) -> str:
        """The message for a name that nothing is registered under, or whose plugin could not be loaded."""
        own_first = sorted(self.broken.items(), key=lambda entry: not entry[0].startswith(f"{name} = "))
        failed = "".join(f" Could not be loaded: {what}: {why}." for what, why in own_first)
        return unknown_name(self.kind, name, self.names()) + failed

    def own(self) -> dict[str, type[T]]:
        """What the running program registered by itself: neither a part of the package nor of an entry point."""
        ours = self.package.split(".")[0] + "."
        found = {name: self._classes[name] for name in self.names() if name not in self._origins}
        return {name: cls for name, cls in found.items() if not cls.__module__.startswith(ours)}

    def name_of(self, cls: type[T]) -> str:
        """The name a class is filed under.

        Raises:
            UnknownNameError: it is not registered.
        """
        for name in self.names():
            if self._classes[name] is cls:
                return name
        raise UnknownNameError(f"{cls.__qualname__} is not a registered {self.kind}. Known: {', '.join(self.names())}.")

    def describe(self, name: str) -> Description:
        """What `name` stands for and where it comes from. Raises as `get`."""
        found = self.get(name)
        module = found.__module__
        origin = "hno" if module.split(".")[0] == "hno" else module
        return Description(name, (inspect.getdoc(found) or "").split("\n")[0], self._origins.get(name, origin))

    def _discover(self) -> None:
        if self._discovered:
            return
        self._discovered = True  # modules that are imported now may look up names themselves
        for module in pkgutil.iter_modules(importlib.import_module(self.package).__path__):
            path = f"{self.package}.{module.name}"
            self._attempt(path, partial(importlib.import_module, path))
        for point in entry_points(group=self.group):
            self._attempt(f'{point.name} = "{point.value}" of {origin_of(point)}', partial(self._load, point))

    def _load(self, point: EntryPoint) -> None:
        self.register(point.name)(point.load())
        self._origins[point.name] = origin_of(point)

    def _attempt(self, what: str, load: Callable[[], object]) -> None:
        """Load a part; one that fails is named and does not stop the others."""
        try:
            load()
        except (Exception, SystemExit) as error:  # noqa: BLE001  # whatever a plugin raises
            self.broken[what] = reason(error)
            message = f"{what} cannot be loaded, so its {self.kind} is missing: {self.broken[what]}. Mend or remove it."
            warnings.warn(message, BrokenPluginWarning, stacklevel=4)


def plural(kind: str) -> str:
    """The plural of a kind, as entry-point groups have it: "games", "losses"."""
    return kind + ("es" if kind.endswith("s") else "s")


def origin_of(point: EntryPoint) -> str:
    """Name and version of the distribution that offers an entry point."""
    return f"{point.dist.name} {point.dist.version}" if point.dist is not None else point.value.partition(":")[0]


def _place(cls: Callable[..., Any]) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"


def reason(error: BaseException) -> str:
    """An error in one line, with the file and the line that it comes from, where that is not the import itself."""
    text = " ".join(f"{type(error).__name__}: {error}".split()).rstrip(".")
    if isinstance(error, SyntaxError):
        return text if error.filename is None else f"{text} ({error.filename})"
    places = [f"{frame.filename}:{frame.lineno}" for frame in traceback.extract_tb(error.__traceback__)]
    places = [place for place in places if "importlib" not in place and not place.startswith(__file__)]
    return f"{text} ({places[-1]})" if places else text


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
