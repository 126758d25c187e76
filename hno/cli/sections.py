"""The sections of an evaluation: those that are asked for, computed and printed."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from hno.cli.progress import progress
from hno.cli.results import Results
from hno.cli.tables import print_table, terminal
from hno.evaluation.format import short_names, title
from hno.evaluation.sections import Evaluation, ModelSection, sections


def chosen_sections(options: Mapping[str, Any]) -> dict[str, ModelSection]:
    """The sections of every model that are asked for, by name; the table is no choice."""
    found = {name: sections.get(name)() for name in sections.names() if name != "table" and options.get(name)}
    return {name: section for name, section in found.items() if isinstance(section, ModelSection)}


def run_sections(evaluation: Evaluation, results: Results) -> Iterator[tuple[str, Any]]:
    """Name and content of every section that is asked for, one after the other."""
    for name, section in chosen_sections(evaluation.options).items():
        began = time.perf_counter()
        with progress(name.replace("_", " ")):
            content = section.compute(evaluation)
        results.time(name, time.perf_counter() - began)
        yield name, content


def show_section(name: str, content: Any, results: Mapping[str, Any], console: Console, title: str = "") -> None:
    """Print a section: its table, under a title or its own heading, and the remarks below it.

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
        titles = [column.title for column in section.columns]
        cells = [[column.format(row[column.name]) for column in section.columns] for row in rows]
        print_table(console, titles, cells, title or section.heading, section.note)
    for remark in section.remarks(content, results):
        console.print(remark, soft_wrap=True)


def show(results: Mapping[str, Any], folder: Path) -> None:
    """Print the sections of every model, the comparison of models and where everything lies."""
    console = terminal()
    models = results.get("models", [results])
    names = short_names([str(model["checkpoint"]) for model in models]) if len(models) > 1 else [""]
    for name, model in zip(names, models, strict=True):
        above = " / ".join(filter(None, (title(model), name)))
        show_section("table", model["table"], results, console, above)
        for key in sections.names():
            if key in model and key not in ("table", "comparison"):
                show_section(key, model[key], results, console)
    if "comparison" in results:
        show_section("comparison", results["comparison"], results, console)
    spent = ", ".join(f"{part.replace('_', ' ')} {seconds:.0f} s" for part, seconds in results["seconds"].items())
    console.print(f"Time: {spent}\nResults: {folder / 'results.json'}", soft_wrap=True)
