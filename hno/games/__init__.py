"""Differential games: physics only, no network and no training."""

from hno.games.base import Box, ControlAffineGame, Game, games

__all__ = ["Box", "ControlAffineGame", "Game", "games", "make"]


def make(name: str, **constants: float) -> Game:
    """The registered game `name`, with constants of its constructor replaced by `constants`.

    Raises:
        UnknownNameError: no game has that name.
        TypeError: the game has no such constant.
    """
    game = games.get(name)(**constants)
    game.constants = dict(constants)
    return game
