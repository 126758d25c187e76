"""Methods that no subclass may override, checked when a class is defined."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar


class FinalMethods:
    """Mixin for classes that share some methods with all their subclasses."""

    INSTEAD: ClassVar[Mapping[str, str]] = {}
    """What is final in the class that sets this, and what to set or override in its place; subclasses may add theirs in
    an attribute of their own."""

    def __init_subclass__(cls, **options: Any) -> None:
        """Refuse a class that overrides what is final.

        Raises:
            TypeError: it does; the message names what to override instead.
        """
        super().__init_subclass__(**options)
        for base in cls.__mro__:
            for name, instead in vars(base).get("INSTEAD", {}).items():
                if next(owner for owner in cls.__mro__ if name in vars(owner)) is not base:
                    raise TypeError(f"{cls.__name__} overrides {name}, which is final: set or override {instead}.")
