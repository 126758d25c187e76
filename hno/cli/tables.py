"""Tables as wide as the terminal: one that is wider is parted, and nothing in it is cut."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Iterator, Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

GAP = 2
"""Characters between columns, one of which is the box's."""
PROSE = 32
"""Width from which on a cell may take several lines."""
WIDTH = 160
"""Columns of text where there is no terminal to ask."""


def terminal() -> Console:
    """Where commands print: as wide as the terminal, or `WIDTH` where there is none."""
    return Console(width=None if sys.stdout.isatty() else WIDTH)


def print_table(
    console: Console, titles: Sequence[str], rows: Sequence[Sequence[str]], title: str = "", note: str = ""
) -> None:
    """Print a table; one that does not fit is parted into several, all of which begin with the first column.

    Args:
        console: where to.
        titles: of the columns.
        rows: a text for every column.
        title: above the table.
        note: below it.
    """
    if title:
        console.print(Text(title, "bold"), soft_wrap=True)
    columns = [(title, [row[at] for row in rows]) for at, title in enumerate(titles)]
    widths = [max(len(title), _width("", cells)) for title, cells in columns]
    if sum(widths) + GAP * (len(widths) - 1) > console.width:
        widths = [_width(*column) for column in columns]
    for part in parts(widths, console.width):
        table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, GAP - 1, 0, 0))
        for column in part:
            table.add_column(_folded(titles[column], widths[column]), width=widths[column], overflow="fold")
        for row in rows:
            table.add_row(*(_folded(row[column], widths[column]) for column in part))
        console.print(table, "")
    if note:
        console.print(Text(note, "dim"))


def _width(title: str, cells: Sequence[str]) -> int:
    """Of a column whose title folds at blanks, as cells do where they are long."""
    words = max(map(len, title.split()), default=1)
    longest = max(map(len, cells), default=1)
    if longest > PROSE:
        longest = max(PROSE, *(len(word) for cell in cells for word in cell.split()))
    return max(words, longest)


def _folded(text: str, width: int) -> Text:
    return Text("\n".join(textwrap.wrap(text, width, break_on_hyphens=False)) or text)


def parts(widths: Sequence[int], room: int) -> Iterator[list[int]]:
    """Numbers of the columns that stand side by side: the first one, and as many others as there is room for.

    Args:
        widths: of all columns.
        room: width of the terminal.
    """
    part = [0]
    for column in range(1, len(widths)):
        if len(part) > 1 and sum(widths[at] + GAP for at in [*part, column]) > room:
            yield part
            part = [0]
        part.append(column)
    yield part
