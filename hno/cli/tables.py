"""The tables that commands print."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.table import Table

from hno.evaluation.sections import sections


def show_section(name: str, content: Any, results: Mapping[str, Any], console: Console, title: str = "") -> None:
    """Print a section of results.json: its table, and the remarks below it.

    Args:
        name: of the section.
        content: of the section.
        results: the other entries of results.json.
        console: where to.
        title: above the table, instead of the section's heading.
    """
    section = sections.get(name)()
    rows = section.rows(content)
    if rows:
        titles = (column.title for column in section.columns)
        table = Table(*titles, title=title or section.heading, caption=section.note or None)
        for row in rows:
            table.add_row(*(column.format(row[column.name]) for column in section.columns))
        console.print(table)
    for remark in section.remarks(content, results):
        console.print(remark, soft_wrap=True)
