"""Plays the runs of a sweep where they were not trained: other boxes, types, noise, delay.

    python benchmarks/suites.py multirun/<date>/<time> [--suites "half types" "2 x box" noise] [--only "sno, sin"]

Suites are in recipe_sets.py; all count starts whose equilibrium keeps 2 cm. What was played before is kept as
`suites.json` in each run's folder. Prints a table per game, one line for every operator and activation, with counts
pooled over seeds and 95 % intervals, and as its last line one JSON object.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import torch
from recipe_sets import SUITES
from recipes import Cases, cell, evaluate, pooled
from rich.console import Console
from rich.table import Table


def finished(sweep: Path) -> dict[str, dict[str, list[Path]]]:
    """Folders of finished runs by game and by operator and activation."""
    found: dict[str, dict[str, list[Path]]] = defaultdict(lambda: defaultdict(list))
    for path in sorted(sweep.glob("*/results.json")):
        content: dict[str, Any] = json.loads(path.read_text())
        if content["status"] == "finished":
            found[content["game"]][f"{content['operator']}, {content['activation']}"].append(path.parent)
    return found


def main() -> None:
    """Play and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sweep", type=Path)
    parser.add_argument("--suites", nargs="+", default=["half types", "2 x box"], choices=sorted(SUITES))
    parser.add_argument("--games", nargs="+")
    parser.add_argument("--only", nargs="+", help='recipes, such as "sno, sin"')
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    console, everything = Console(width=60 + 50 * len(arguments.suites)), {}
    for game, recipes in finished(arguments.sweep).items():
        if arguments.games and game not in arguments.games:
            continue
        cases: Cases = {}
        table = Table("recipe", "seeds", *arguments.suites, title=game)
        for name, folders in recipes.items():
            if arguments.only and name not in arguments.only:
                continue
            rows = [{"suites": evaluate(folder, game, arguments.suites, cases)} for folder in folders]
            found = {suite: pooled(rows, suite) for suite in arguments.suites}
            table.add_row(name, str(len(rows)), *map(cell, found.values()))
            everything[f"{game}/{name}"] = {"seeds": len(rows), "suites": found}
        console.print(table)
    if not everything:
        raise SystemExit(f"{arguments.sweep} holds no finished run of {arguments.games or 'any game'}.")
    print(json.dumps(everything))


if __name__ == "__main__":
    main()
