"""What becomes of nets that were trained apart when they decide together.

    python benchmarks/ensembles.py "outputs/recipes/drone/drone/one net/"* [--members 3] [--suites validation]

Run folders of benchmarks/recipes.py, in groups of so many. Plays every net alone; the median and the mean of their
costates, entry by entry; and of every group the net whose values have the largest sum over the players at a state, or
the median one, so that all costates are of one net. Prints collisions over all groups and one JSON object.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from recipe_sets import SUITES
from recipes import starts
from torch import Tensor

from hno.control.rollout import Player, rollout
from hno.evaluation.metrics import clopper_pearson
from hno.games import games
from hno.operators import ValueOperator
from hno.training.checkpoint import load_operator
from hno.types import Field, Points

Choice = Callable[[Tensor, Tensor], Tensor]
"""Costates (B, P, P, n) from those of all members (M, B, P, P, n) and from their values (M, B, P)."""


def of_member(costates: Tensor, member: Tensor) -> Tensor:
    """Costates of one member per row, (B,) -> (B, P, P, n)."""
    return costates[member, torch.arange(len(member))]


CHOICES: dict[str, Choice] = {
    "median": lambda costates, _: costates.median(0).values,
    "mean": lambda costates, _: costates.mean(0),
    "largest sum of values": lambda costates, values: of_member(costates, values.sum(-1).argmax(0)),
    "median sum of values": lambda costates, values: of_member(costates, values.sum(-1).median(0).indices),
}


def together(operators: Sequence[ValueOperator], choice: Choice) -> Player:
    """The policy of several operators."""

    def policy(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        fields = [operator.field(Points(tau, x, theta)) for operator in operators]
        every = Field(*(torch.stack(parts) for parts in zip(*fields, strict=True)))
        return operators[0].game.optimal_control(x, choice(every.costate, every.value))

    return policy


def main() -> None:
    """Play and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--members", type=int, default=3)
    parser.add_argument("--suites", nargs="+", default=["validation", "integer types"], choices=sorted(SUITES))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    size, folders = arguments.members, arguments.folders
    if not 1 <= size <= len(folders):
        raise SystemExit(f"--members must be from 1 to the number of folders, {len(folders)}; got {size}.")
    nets = [load_operator(folder / "best.ckpt")[0] for folder in folders]
    groups = [nets[at : at + size] for at in range(0, len(nets) - size + 1, size)]
    everything = {}
    for suite in arguments.suites:
        at, _ = starts(games.name_of(type(nets[0].game)), suite)
        cases = {"alone": [together([net], CHOICES["median"]) for group in groups for net in group]}
        cases |= {name: [together(group, choice) for group in groups] for name, choice in CHOICES.items()}
        for name, policies in cases.items():
            played = [rollout(nets[0].game, policy, at.x0, at.theta) for policy in policies]
            hits, among = sum(int((~(one.clearance > 0)).sum()) for one in played), len(played) * len(at.x0)
            low, high = clopper_pearson(hits, among) or (0.0, 1.0)
            print(f"{suite}, {name}: {hits} of {among:,} ({100 * low:.2f} to {100 * high:.2f} %)", flush=True)
            everything[f"{suite}/{name}"] = {"collisions": hits, "starts": among}
    print(json.dumps(everything))


if __name__ == "__main__":
    main()
