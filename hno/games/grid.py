"""Player types written as text."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from hno.games.base import Game

GRIDS = {"grid5": 5, "grid9": 9}
"""Named grids over the type box: points per player."""


def parse_types(game: Game, text: str, also: Sequence[str] = ()) -> list[tuple[float, ...]]:
    """Player types from a named grid, or from a list such as "1,1;2.5,4".

    Args:
        game: the game.
        text: the name or the list.
        also: further names that the caller knows, for the message.

    Raises:
        ValueError: neither, or entries that are not one finite number per player.
    """
    if text in GRIDS:
        corners = zip(game.type_box.lo.tolist(), game.type_box.hi.tolist(), strict=True)
        steps = GRIDS[text] - 1
        axes = [[lo + (hi - lo) * k / steps for k in range(steps + 1)] for lo, hi in corners]
        return game.validate_types(list(itertools.product(*axes)))
    try:
        types = [[float(entry) for entry in part.split(",")] for part in str(text).split(";")]
    except ValueError as error:
        known = ", ".join((*also, *GRIDS))
        raise ValueError(f"theta must be one of {known}, or a list such as '1,1;2.5,4'; got {text!r}.") from error
    return game.validate_types(types)
