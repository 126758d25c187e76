"""How many labels need nodes where controls reach their bounds.

    python benchmarks/kinks.py [--games narrow_road lane_change drone] [--starts 256]

The same random starts and integer types, solved with such nodes and without: converged with a re-integration error of
at most 1e-4 of the box.
"""

from __future__ import annotations

import argparse
import json

import torch

from hno.games import make
from hno.pontryagin import Solver, solve
from hno.types import Status

ENDLESS = 1e30
"""A re-integration error that nothing exceeds: no trajectory is then solved again for it."""


def accepted(name: str, starts: int, settings: Solver) -> int:
    """Converged rows whose controls lead where their states say."""
    game, generator = make(name), torch.Generator().manual_seed(0)
    x0 = game.initial_box.sample(starts, generator)
    theta = torch.randint(1, 6, (starts, game.players), generator=generator).double()
    found = solve(game, x0, theta, settings)
    return int(((found.status == Status.CONVERGED) & (found.reintegration <= Solver().reintegration)).sum())


def main() -> None:
    """Print the table and one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--games", nargs="+", default=["narrow_road", "lane_change", "drone"])
    parser.add_argument("--starts", type=int, default=256)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print("game          with nodes on kinks  without")
    rows = []
    for name in arguments.games:
        counts = [accepted(name, arguments.starts, s) for s in (Solver(), Solver(reintegration=ENDLESS))]
        rows.append({"game": name, "starts": arguments.starts, "with": counts[0], "without": counts[1]})
        print(f"{name:14}{counts[0]:8} of {arguments.starts}{counts[1]:9}", flush=True)
    print(json.dumps({"games": rows}))


if __name__ == "__main__":
    main()
