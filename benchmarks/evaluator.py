"""How long the closed-loop evaluation of 25 types x 200 starts takes.

    python benchmarks/evaluator.py [--game narrow_road] [--starts 200] [--repeats 3]

The baseline evaluates one type after the other. The network is not trained: time does not depend on the weights.
Solving the labels of the starts is not part of it; they are cached between evaluations.
"""

from __future__ import annotations

import argparse
import itertools
import json
import statistics
import time
from collections.abc import Callable

import torch

from hno.control import Feedback
from hno.control.rollout import rollout
from hno.games import make
from hno.operators import make_operator


def seconds(run: Callable[[], object]) -> float:
    """Wall-clock time of one call."""
    began = time.perf_counter()
    run()
    return time.perf_counter() - began


def main() -> None:
    """Print the table and one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--game", default="narrow_road")
    parser.add_argument("--starts", type=int, default=200)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    game = make(arguments.game)
    policy = Feedback(make_operator(game).eval().requires_grad_(False))
    types = torch.tensor(list(itertools.product(range(1, 6), repeat=2)), dtype=torch.float32)
    starts = game.initial_box.sample(len(types) * arguments.starts, torch.Generator().manual_seed(0))
    theta = types.repeat_interleave(arguments.starts, 0)
    size = arguments.starts

    def together() -> object:
        return rollout(game, policy, starts, theta)

    def one_by_one() -> object:
        return [rollout(game, policy, x, t) for x, t in zip(starts.split(size), theta.split(size), strict=True)]

    times = [(seconds(one_by_one), seconds(together)) for _ in range(arguments.repeats)]
    baseline, ours = (statistics.median(column) for column in zip(*times, strict=True))
    print(f"{'one type after the other':28s}{baseline:8.1f} s\n{'all types together':28s}{ours:8.1f} s")
    sizes = {"types": len(types), "starts": size, "repeats": arguments.repeats}
    print(json.dumps({"ratio": baseline / ours, "baseline_s": baseline, "ours_s": ours, "threads": 1, **sizes}))


if __name__ == "__main__":
    main()
