"""Where a trained model satisfies the HJI equation, and whether that makes it safe.

    python benchmarks/residual.py "outputs/recipes/any type/lane_change/"*/0

Prints, for every run folder of benchmarks/recipes.py, the mean residual as the loss measures it (relative to values per
horizon plus the local penalty) uniformly in the PDE box, in the band around the constraint and around label states, at
the types with labels and at (2, 2), which has none; and the collisions of the validation suite at (2, 2) and in all.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from hno.data.labels import Request, default_cache, labels_for
from hno.data.rows import rows_of
from hno.data.sampling import sample_states
from hno.games import Game
from hno.losses import Scales
from hno.losses.hji import HJIResidual
from hno.operators import ValueOperator
from hno.operators.checkpoint import load_operator
from hno.types import Sample

UNSEEN = (2.0, 2.0)
REGIONS = ("box", "band", "labels")


def residual(operator: ValueOperator, theta: tuple[float, ...], region: str, pool: Sample, size: int = 4096) -> float:
    """Mean scaled residual at one type."""
    game, generator = operator.game, torch.Generator().manual_seed(0)
    types = torch.tensor(theta).expand(size, -1)
    states = pool.points.tau, pool.points.x
    points = sample_states(game, types, {region: 1.0}, {"labels": states}, 1.0, generator)
    term, sample = HJIResidual(), Sample(points)
    found = term.residual(game, sample, operator.field(points))
    return float((found / term.scale(game, sample, Scales(operator.value_scale, operator.costate_scale))).abs().mean())


def label_states(game: Game, theta: tuple[float, ...]) -> Sample:
    """Nodes of test labels of a type."""
    found, _ = labels_for(game, [Request(theta, 128, 1000, "test")], default_cache())
    return rows_of(game, found)


def main() -> None:
    """Print the table and one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+")
    folders = parser.parse_args().folders
    torch.set_num_threads(1)
    columns = [f"{region}, {which}" for which in ("seen", "unseen") for region in REGIONS]
    table, everything, pools = Table("run", *columns, "collisions at (2, 2)", "in all"), {}, {}
    for folder in folders:
        operator = load_operator(folder / json.loads((folder / "results.json").read_text())["checkpoint"])
        game, seen = operator.game, operator.seen_types[0]
        for theta in (seen, UNSEEN):
            pools.setdefault((type(game), theta), label_states(game, theta))
        found = {
            name: residual(operator, theta, region, pools[type(game), theta])
            for name, (theta, region) in zip(
                columns, [(theta, region) for theta in (seen, UNSEEN) for region in REGIONS], strict=True
            )
        }
        suite = json.loads((folder / "suites.json").read_text())["validation"]
        place = [(a, b) for a in range(1, 6) for b in range(1, 6)].index(UNSEEN)
        hits = f"{suite['collisions'][place]} of {suite['starts'][place]}", f"{sum(suite['collisions'])}"
        table.add_row(str(folder.parent.name), *(f"{value:.2f}" for value in found.values()), *hits)
        everything[str(folder.parent.name)] = {**found, "collisions": suite["collisions"]}
    Console(width=150).print(table)
    print(json.dumps(everything))


if __name__ == "__main__":
    main()
