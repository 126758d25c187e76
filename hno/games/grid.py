"""Player types as people write them: a named grid, text, or a list."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence

from hno.games.base import Game


def parse_types(
    game: Game, choice: str | Sequence[Sequence[float]] | None, *, key: str = "data.types", also: Sequence[str] = ()
) -> list[tuple[float, ...]]:
    """Player types from what a configuration holds.

    Args:
        game: the game.
        choice: "corners" of the type box; "gridN", N values of every player's type; a list of types, as it is or as
            text such as "1,1;2.5,4"; None for the game's default types.
        key: where the choice stands, for the message.
        also: further names that the caller knows, for the message.

    Raises:
        ValueError: none of these, or entries that are not one finite number per player.
    """
    if choice is None:
        return game.validate_types(game.default_types())
    grid = re.fullmatch(r"grid([1-9]\d*)", "grid2" if choice == "corners" else str(choice))
    try:
        if grid and int(grid[1]) > 1:
            return game.validate_types(_lattice(game, int(grid[1])))
        if isinstance(choice, (str, int, float)):
            choice = [[float(entry) for entry in part.split(",")] for part in str(choice).split(";")]
        return game.validate_types(choice)
    except (TypeError, ValueError) as error:
        reason = "" if "finite numbers" not in str(error) else f" {error}"
        known = ", ".join((*also, "corners", "gridN (as in grid5)"))
        raise ValueError(
            f"{key} must be one of {known}, or a list such as '1,1;2.5,4'; got {choice!r}.{reason}"
        ) from error


def quarter_types(game: Game) -> list[tuple[float, ...]]:
    """Four types at quarters of the type box; all players but the first are of one type."""
    lo, width = game.type_box.lo, game.type_box.hi - game.type_box.lo
    places = [[first, *[others] * (game.players - 1)] for first, others in ((0, 1), (1, 1), (1, 3), (3, 4))]
    return game.validate_types([(lo + width * lo.new_tensor(row) / 4).tolist() for row in places])


def _lattice(game: Game, count: int) -> list[tuple[float, ...]]:
    """All combinations of `count` equally spaced types of each player."""
    corners, steps = zip(game.type_box.lo.tolist(), game.type_box.hi.tolist(), strict=True), count - 1
    return list(itertools.product(*([lo + (hi - lo) * k / steps for k in range(count)] for lo, hi in corners)))
