"""Seconds per label against one-by-one `scipy.integrate.solve_bvp`, and a thousand labels on all cores.

    python benchmarks/labels.py [--games narrow_road lane_change drone] [--starts 10] [--thousand 1000]

The baseline solves the same start states with the same right-hand side from four starts at tolerance 5e-3. Both run in
turns on one thread, at random integer types. A label counts when it is accepted: converged, and for ours confirmed by
re-integration. Ours come in batches, as in use; "bare" leaves the certificates out, which the baseline has not either.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import torch

from hno.data.labels import Request, labels_for
from hno.games import make
from hno.pontryagin import solve
from hno.pontryagin.scipy_reference import solve_one
from hno.pontryagin.solve import solve_on_mesh
from hno.types import Status

BATCH = 128
"""States that `solve` gets at once; its time per label depends on it."""


def compare(name: str, starts: int) -> dict[str, Any]:
    """One line of the table."""
    game, generator = make(name).double(), torch.Generator().manual_seed(1)
    x0 = game.initial_box.sample(BATCH, generator)
    theta = torch.randint(1, 6, (BATCH, game.players), generator=generator).double()
    ours, bare, baseline, solved = [], [], 0.0, 0
    for row in range(starts):
        began = time.perf_counter()
        solved += solve_one(game, x0[row], theta[row]).converged
        baseline += time.perf_counter() - began
        if row % 3 == 0:
            began = time.perf_counter()
            accepted = int((solve(game, x0, theta).status == Status.CONVERGED).sum())
            middle = time.perf_counter()
            converged = int((solve_on_mesh(game, x0.double(), theta).status == Status.CONVERGED).sum())
            ours.append((middle - began) / max(1, accepted))
            bare.append((time.perf_counter() - middle) / max(1, converged))
    scipy_seconds = baseline / max(1, solved)
    return {
        "game": name,
        "ratio": scipy_seconds / median(ours),
        "ratio_bare": scipy_seconds / median(bare),
        "baseline_s": scipy_seconds,
        "baseline_converged": solved,
        "ours_s": median(ours),
        "bare_s": median(bare),
        "accepted": accepted,
    }


def thousand(count: int) -> float:
    """Wall seconds for narrow_road labels of one type on all cores, certificates and files included."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        labels_for(make("narrow_road"), [Request((3.0, 3.0), count, 0, "train")], Path(folder))
        return time.perf_counter() - began


def main() -> None:
    """Print the table and one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--games", nargs="+", default=["narrow_road", "lane_change", "drone"])
    parser.add_argument("--starts", type=int, default=10)
    parser.add_argument("--thousand", type=int, default=1000, help="labels of the run on all cores, 0 for none")
    arguments = parser.parse_args()
    seconds = thousand(arguments.thousand) if arguments.thousand else None
    if seconds is not None:
        print(f"{arguments.thousand} narrow_road labels with certificates on all cores: {seconds:.1f} s")
    torch.set_num_threads(1)
    rows = [compare(name, arguments.starts) for name in arguments.games]
    print("game          scipy s/label (converged)   ours s/label (accepted)   ratio   bare s/label   ratio")
    for row in rows:
        print(
            f"{row['game']:14}{row['baseline_s']:10.2f} ({row['baseline_converged']} of {arguments.starts})"
            f"{row['ours_s']:18.4f} ({row['accepted']} of {BATCH}){row['ratio']:9.0f}"
            f"{row['bare_s']:15.4f}{row['ratio_bare']:8.0f}"
        )
    print(json.dumps({"ratio": rows[0]["ratio"], "threads": 1, "thousand_s": seconds, "games": rows}))


if __name__ == "__main__":
    main()
