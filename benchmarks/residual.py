"""Where a trained model satisfies the HJI equation, and whether that makes it safe.

    python benchmarks/residual.py "outputs/recipes/any type/lane_change/"*/0

Prints, for every run folder of benchmarks/recipes.py, the mean residual as the loss measures it (relative to values per
horizon plus the local penalty) region by region (`hno.evaluation.residuals`), at the types with labels and at (2, 2),
which has none; and the collisions of the validation suite at (2, 2) and in all.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import annealed  # noqa: F401  # registers a loss term
import torch
from rich.console import Console
from rich.table import Table

from hno.data.labels import Request, default_cache, labels_for
from hno.evaluation.residuals import REGIONS, residual_table
from hno.training.checkpoint import load_operator

UNSEEN = (2.0, 2.0)


def main() -> None:
    """Print the table and one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+")
    folders = parser.parse_args().folders
    torch.set_num_threads(1)
    columns = [f"{region}, {which}" for which in ("seen", "unseen") for region in REGIONS]
    table, everything = Table("run", *columns, "collisions at (2, 2)", "in all"), {}
    for folder in folders:
        operator, _, origin = load_operator(folder / json.loads((folder / "results.json").read_text())["checkpoint"])
        requests = [Request(theta, 128, 1000, "test") for theta in (origin.types[0], UNSEEN)]
        labels, _ = labels_for(operator.game, requests, default_cache())
        rows = residual_table(operator, labels, origin.types)
        found = {column: row.scaled for column, row in zip(columns, rows, strict=True)}
        suite = json.loads((folder / "suites.json").read_text())["validation"]
        place = [(a, b) for a in range(1, 6) for b in range(1, 6)].index(UNSEEN)
        hits = f"{suite['collisions'][place]} of {suite['starts'][place]}", f"{sum(suite['collisions'])}"
        table.add_row(str(folder.parent.name), *(f"{value:.2f}" for value in found.values()), *hits)
        everything[str(folder.parent.name)] = {**found, "collisions": suite["collisions"]}
    Console(width=150).print(table)
    print(json.dumps(everything))


if __name__ == "__main__":
    main()
