"""Labels per second, and how good they are, against one-by-one `scipy.integrate.solve_bvp`.

    python benchmarks/labels.py [--games narrow_road lane_change drone] [--starts 10] [--theta 3 3]

The baseline solves the same start states with the same right-hand side from four starts at tolerance 5e-3. Both run in
turns on one thread. A label counts when it converged.
"""

from __future__ import annotations

import argparse
import json
import time

import torch

from hno.games import make
from hno.pontryagin import solve
from hno.pontryagin.scipy_reference import solve_one
from hno.types import Status

BATCH = 128
"""States that `solve` gets at once; its time per label depends on it."""


def compare(name: str, starts: int, theta: list[float]) -> dict[str, float | str]:
    """One line of the table."""
    game = make(name)
    x0 = game.initial_box.sample(BATCH, torch.Generator().manual_seed(0))
    types = torch.tensor([theta]).expand(BATCH, -1)
    began = time.perf_counter()
    ours = solve(game, x0, types)
    our_time = (time.perf_counter() - began) / max(1, int((ours.status == Status.CONVERGED).sum()))
    gaps, solved = [], 0
    began = time.perf_counter()
    for row in range(starts):
        reference = solve_one(game, x0[row], types[row])
        solved += reference.converged
        if reference.converged and ours.status[row] == Status.CONVERGED:
            gaps.append(float((reference.value.sum() - ours.value[row, 0].sum()) / ours.value[row, 0].sum().abs()))
    baseline = (time.perf_counter() - began) / max(1, solved)
    times = {"ratio": baseline / our_time, "baseline_s": baseline, "ours_s": our_time, "baseline_converged": solved}
    nothing = float("nan")
    return {"game": name, **times, "best_gap": max(gaps, default=nothing), "worst_gap": min(gaps, default=nothing)}


def main() -> None:
    """Print the table and one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--games", nargs="+", default=["narrow_road", "lane_change", "drone"])
    parser.add_argument("--starts", type=int, default=10)
    parser.add_argument("--theta", nargs="+", type=float, default=[3.0, 3.0])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = [compare(name, arguments.starts, arguments.theta) for name in arguments.games]
    print("game          scipy s/label  ours s/label  ratio  converged  joint value of scipy above ours, best / worst")
    for row in rows:
        print(
            f"{row['game']:14}{row['baseline_s']:13.2f}{row['ours_s']:14.4f}{row['ratio']:7.0f}"
            f"{row['baseline_converged']:9} of {arguments.starts}    {row['best_gap']:+.2%} / {row['worst_gap']:+.2%}"
        )
    print(json.dumps({"ratio": rows[0]["ratio"], "threads": 1, "starts": arguments.starts, "games": rows}))


if __name__ == "__main__":
    main()
