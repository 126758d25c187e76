"""How far a label's costates are from the gradient of the equilibrium value, and of the potential, over start states.

    python benchmarks/costates.py [--games narrow_road lane_change drone intersection] [--starts 100]

An open-loop costate is the gradient of V_i at everybody's *fixed* controls. The total derivative also holds the
others' answer to a changed start, which is not zero in a general-sum game. It is taken here by central differences:
the equilibrium of the shifted start is reached by Newton from the solved one, so that it stays in its family. Own
costates are compared with the gradient of the potential W as well.
"""

from __future__ import annotations

import argparse
import json
from typing import Any

import torch
from torch import Tensor

from hno.games import Game, make
from hno.games.potential import Team
from hno.pontryagin.collocation import Collocation, Iterate
from hno.pontryagin.newton import Newton, newton
from hno.pontryagin.solve import along_mesh, solve_on_mesh
from hno.pontryagin.sweep import costates, values
from hno.types import Status


def shifted_values(game: Game, at: Iterate, shift: Tensor) -> Tensor:
    """V_i and, behind them, W at equilibria of shifted starts, NaN where Newton does not converge, (B, P + 1)."""
    start = at._replace(z=at.z.clone())
    start.z[:, 0, : shift.numel()] += shift.flatten()
    found = newton(Collocation(game), start, Newton())
    reached = start._replace(z=found.z)
    path = along_mesh(game, reached)
    value = torch.cat([values(problem, at.t, *path, at.theta)[:, 0] for problem in (game, Team(game))], -1)
    return torch.where((found.status == Status.CONVERGED).unsqueeze(-1), value, torch.nan)


def compare(name: str, starts: int, step: float = 1e-4) -> dict[str, Any]:
    """One line of the table, in units of the costate's size; a costate counts times the width of the start box."""
    game, generator = make(name).double(), torch.Generator().manual_seed(5)
    x0 = game.initial_box.sample(starts, generator).double()
    theta = torch.randint(1, 6, (starts, game.players), generator=generator).double()
    with torch.no_grad():
        found = solve_on_mesh(game, x0, theta)
        at = found.at
        costate = costates(game, at.t, *along_mesh(game, at), at.theta)[:, 0]
        width = game.initial_box.width.clamp_min(1e-3 * game.state_box.width)
        slopes = []
        for shift in torch.eye(width.numel(), dtype=x0.dtype) * step:
            both = [shifted_values(game, at, sign * shift.view_as(width) * width) for sign in (1, -1)]
            slopes.append((both[0] - both[1]) / (2 * step))
    slopes_of = torch.stack(slopes, -1).unflatten(-1, width.shape)
    total = slopes_of[:, :-1]
    fixed = costate * width
    good = (found.status == Status.CONVERGED) & total.isfinite().all((1, 2, 3))
    own = torch.eye(game.players, dtype=torch.bool)
    error, size = (total - fixed)[good], fixed[good].square().sum((-1, -2, -3)).sqrt()
    parts = {"own": error[:, own], "cross": error[:, ~own], "all": error.flatten(1, 2)}
    relative = {part: values_.square().sum((-1, -2)).sqrt() / size for part, values_ in parts.items()}
    of_own = fixed[good][:, own]
    potential = (slopes_of[good][:, -1] - of_own).square().sum((-1, -2)).sqrt()
    relative["W"] = potential / of_own.square().sum((-1, -2)).sqrt()
    shares = torch.tensor([0.5, 0.9], dtype=x0.dtype)
    return {
        "game": name,
        "starts": starts,
        "compared": int(good.sum()),
        **{part: ratio.quantile(shares).tolist() for part, ratio in relative.items()},
    }


def main() -> None:
    """Print the table and one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--games", nargs="+", default=["narrow_road", "lane_change", "drone", "intersection"])
    parser.add_argument("--starts", type=int, default=100)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print("Of V_i: own, cross and all costates; of W: own costates. Medians and 90 % quantiles of relative errors.")
    rows = [compare(name, arguments.starts) for name in arguments.games]
    for row in rows:
        cells = "".join(f"   {part} {row[part][0]:.2g}, {row[part][1]:.2g}" for part in ("own", "cross", "all", "W"))
        print(f"{row['game']:14}{row['compared']:5} of {row['starts']}{cells}")
    print(json.dumps({"games": rows}))


if __name__ == "__main__":
    main()
