"""`hno check-game`: whether a game keeps the contract."""

from __future__ import annotations

import inspect
import pkgutil
import sys
from pathlib import Path
from typing import Any

from hno.cli.arguments import Arguments, UsageError
from hno.cli.logs import use_threads
from hno.registry import UnknownNameError, reason

PREFIX = "game.constants."


def run(given: Arguments) -> int:
    """`hno check-game NAME|MODULE:CLASS`."""
    if len(given.words) != 1:
        raise UsageError("Name one game: a registered name, or module:Class of a file in this folder.")
    from hno.games import make
    from hno.games.potential import GAP, potential_gap
    from hno.games.testing import ContractError, check_game

    use_threads(1)
    name, constants, place = given.words[0], _constants(given.overrides), ""
    try:
        game = _class(name)(**constants) if ":" in name else make(name, **constants)
        place = f" It is in {inspect.getsourcefile(type(game))}."
        check_game(game)
    except Exception as error:  # whatever a file of the user's raises
        said = str(error) if isinstance(error, (ContractError, UnknownNameError)) else reason(error)
        print(f"{name} cannot be used yet: {said}{place}", file=sys.stderr)
        return 1
    print(
        f"{name} keeps the contract of a game: {game.players} players, {game.state_dim} states and "
        f"{game.control_dim} controls each, {game.horizon:g} s."
    )
    if game.potential:
        print("It is a potential game: function=potential learns one function for all players, and is the default.")
    elif game.players > 1 and potential_gap(game) <= GAP:
        print("It is a potential game and does not say so. With `potential = True` it is learned by one function.")
    return 0


def _class(name: str) -> Any:
    """The class of a file in this folder."""
    from hno.games import Game

    sys.path.insert(0, str(Path.cwd()))
    try:
        found = pkgutil.resolve_name(name)
    finally:
        sys.path.remove(str(Path.cwd()))
    if not (isinstance(found, type) and issubclass(found, Game)):
        raise UnknownNameError("{0} has no class {2!r} that is a Game.".format(*name.partition(":")))
    return found


def _constants(overrides: list[str]) -> Any:
    from omegaconf import OmegaConf

    wrong = [override for override in overrides if not override.lstrip("+").startswith(PREFIX)]
    if wrong:
        raise UsageError(f"{wrong[0]}: a game takes {PREFIX}<name>=<value> only.")
    given = [override.lstrip("+").removeprefix(PREFIX) for override in overrides]
    return OmegaConf.to_object(OmegaConf.from_dotlist(given)) if given else {}
