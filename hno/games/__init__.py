"""Differential games: physics only, no network and no training."""

import inspect

from hno.games.base import Box, ControlAffineGame, Game, games
from hno.games.collision import CollisionAvoidance
from hno.registry import UnknownNameError, unknown_name

__all__ = ["Box", "CollisionAvoidance", "ControlAffineGame", "Game", "games", "make"]


def make(name: str, **constants: float) -> Game:
    """The registered game `name`, with constants of its constructor replaced by `constants`.

    Raises:
        UnknownNameError: no game has that name, or the game has no such constant.
    """
    cls = games.get(name)
    known = list(inspect.signature(cls).parameters)
    for constant in constants:
        if constant not in known:
            raise UnknownNameError(unknown_name(f"constant of {name}", constant, known))
    game = cls(**constants)
    game.constants = dict(constants)
    return game
