"""Joint cost of our equilibria against the best of four `solve_bvp` attempts, both replayed the same way.

    python benchmarks/equilibria.py [--games narrow_road lane_change drone] [--starts 50]

Replayed: the states are driven from their start by the solution's controls, and the cost is what that spends.
"""

from __future__ import annotations

import argparse
import json
from typing import Any

import torch

from hno.games import make
from hno.pontryagin.certificates import replay
from hno.pontryagin.collocation import Iterate
from hno.pontryagin.scipy_reference import attempts
from hno.pontryagin.solve import solve_on_mesh
from hno.types import Status


def compare(name: str, starts: int) -> dict[str, Any]:
    """One line of the table: how far our joint cost is above the best attempt's, relative."""
    game, generator = make(name).double(), torch.Generator().manual_seed(77)
    x0 = game.initial_box.sample(starts, generator).double()
    theta = torch.randint(1, 6, (starts, game.players), generator=generator).double()
    found = [(row, a) for row in range(starts) for a in attempts(game, x0[row], theta[row]) if a.converged]
    if not found:
        raise SystemExit(f"No attempt of the baseline converged on {starts} starts of {name}: ask for more --starts.")
    paths = Iterate(*(torch.cat(part) for part in zip(*(attempt.path for _, attempt in found), strict=True)))
    ours = solve_on_mesh(game, x0, theta)
    with torch.no_grad():
        reference = -replay(game, paths, substeps=1)[1].sum(-1)
        cost = -replay(game, ours.at)[1].sum(-1)
    rows = torch.tensor([row for row, _ in found])
    best = torch.full_like(cost, torch.inf).scatter_reduce(0, rows, reference, "amin")
    both = best.isfinite() & (ours.status == Status.CONVERGED)
    above = ((cost - best) / best.abs().clamp_min(1))[both].sort().values
    shares = torch.tensor([0.0, 0.1, 0.5, 0.9, 1.0], dtype=above.dtype)
    return {
        "game": name,
        "starts": starts,
        "ours_converged": int((ours.status == Status.CONVERGED).sum()),
        "scipy_converged": int(best.isfinite().sum()),
        "compared": len(above),
        "above_a_thousandth": int((above > 1e-3).sum()),
        "below_a_thousandth": int((above < -1e-3).sum()),
        "quantiles": above.quantile(shares).tolist(),
    }


def main() -> None:
    """Print the table and one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--games", nargs="+", default=["narrow_road", "lane_change", "drone"])
    parser.add_argument("--starts", type=int, default=50)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print("game          ours  scipy  compared  > +0.1 %  < -0.1 %  lowest, 10 %, median, 90 %, highest")
    rows = []
    for name in arguments.games:
        row = compare(name, arguments.starts)
        rows.append(row)
        counts = (row["ours_converged"], row["scipy_converged"], row["compared"])
        print(
            f"{name:14}{counts[0]:4}{counts[1]:7}{counts[2]:10}{row['above_a_thousandth']:10}"
            f"{row['below_a_thousandth']:10}  " + ", ".join(f"{q:+.1e}" for q in row["quantiles"]),
            flush=True,
        )
    print(json.dumps({"games": rows}))


if __name__ == "__main__":
    main()
