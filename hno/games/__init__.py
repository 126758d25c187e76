"""Differential games: physics only, no network and no training."""

import inspect
import math
from collections.abc import Sequence

from hno.games.affine import ControlAffineGame
from hno.games.base import Game, games
from hno.games.box import Box
from hno.games.collision import CollisionAvoidance
from hno.games.plane import Axis, Plane
from hno.registry import UnknownNameError, unknown_name

__all__ = ["Axis", "Box", "CollisionAvoidance", "ControlAffineGame", "Game", "Plane", "games", "make"]


def make(name: str, **constants: float | Sequence[float]) -> Game:
    """The registered game `name`, with constants of its constructor replaced by `constants`.

    Raises:
        UnknownNameError: no game has that name, or the game has no such constant.
        ValueError: a constant is not a finite number, or a tuple of them; or one that must be positive is not.
    """
    cls = games.get(name)
    known = list(inspect.signature(cls).parameters)
    for constant, value in constants.items():
        if constant not in known:
            raise UnknownNameError(unknown_name(f"constant of {name}", constant, known))
        numbers = value if isinstance(value, Sequence) else [value]
        if not all(isinstance(number, (int, float)) and math.isfinite(number) for number in numbers):
            raise ValueError(f"The constant {constant!r} of {name} must be finite; got {value!r}.")
    game = cls(**constants)
    game.check_constants()
    game.constants = dict(constants)
    return game
