"""What a label costs: against nodes, starts and state dimension, where the time goes, and the flops of the elimination.

    python benchmarks/label_cost.py [--game narrow_road] [--repeats 3]

Processor seconds on one thread, the least of several repeats. The flops are those of the block elimination of one
Newton system in real arithmetic; the peak is that of a large matrix product on the same thread.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import torch
from torch import Tensor

from hno.games import Box, Game, make
from hno.games.collision import CollisionAvoidance
from hno.games.kinematics import double_integrator_drift
from hno.pontryagin.solve import Solver, solve

solver = import_module("hno.pontryagin.solve")
PARTS = ("find_starts", "newton", "rescue", "nodes_at_kinks", "costates", "values", "local_gap", "global_gap")
"""Functions of the solver whose time is taken apart."""


class PointMasses(CollisionAvoidance):
    """Two point masses in any number of dimensions who swap places along the first axis.

    Args:
        dimensions: of space; a player has twice as many states.
    """

    def __init__(self, dimensions: int) -> None:
        super().__init__()
        self.horizon, self.radius, self.first_sensor, self.sensor_count = 3.0, 0.5, 0.5, 10
        across, fast = torch.ones(dimensions - 1), 4 * torch.ones(dimensions)
        ahead, rest = torch.ones(1), torch.zeros(dimensions - 1)
        low, high = torch.cat([-ahead, -2 * across, -fast]), torch.cat([7 * ahead, 2 * across, fast])
        self.state_box = Box([low.tolist()] * 2, [high.tolist()] * 2)
        low = torch.cat([0 * ahead, -0.2 * across, 1.5 * ahead, rest])
        high = torch.cat([0.5 * ahead, 0.2 * across, 2 * ahead, rest])
        self.initial_box = Box([low.tolist()] * 2, [high.tolist()] * 2)
        self.control_box = Box([-3.0] * dimensions, [3.0] * dimensions)
        self.type_box = Box([1, 1], [5, 5])
        identity = torch.eye(dimensions)
        self.register_buffer("input_matrix", torch.cat([torch.zeros_like(identity), identity]))
        self.register_buffer("effort_weight", torch.ones(dimensions))

    def drift(self, x: Tensor) -> Tensor:
        """Motion at constant velocity."""
        return double_integrator_drift(x)

    def positions(self, x: Tensor) -> Tensor:
        """Player 2 runs the other way along the first axis."""
        place = x[..., : x.shape[-1] // 2]
        mirrored = torch.cat([5 - place[..., 1, :1], place[..., 1, 1:]], -1)
        return torch.stack([place[..., 0, :], mirrored], -2)

    def terminal_value(self, x: Tensor) -> Tensor:
        """Progress, and no velocity across."""
        half = x.shape[-1] // 2
        return -(x[..., half] - 2).square() - x[..., 1:half].square().sum(-1)


def seconds(call: Callable[[], object], repeats: int) -> float:
    """Least processor seconds of a call."""
    times = []
    for _ in range(repeats):
        began = time.process_time()
        call()
        times.append(time.process_time() - began)
    return min(times)


def label_seconds(game: Game, starts: int, settings: Solver, repeats: int) -> float:
    """Seconds per start at random integer types."""
    generator = torch.Generator().manual_seed(0)
    x0 = game.initial_box.sample(starts, generator)
    theta = torch.randint(1, 6, (starts, game.players), generator=generator).double()
    return seconds(lambda: solve(game, x0, theta, settings), repeats) / starts


@contextmanager
def taken_apart() -> Iterator[dict[str, float]]:
    """Processor seconds of the solver's parts while the context lasts."""
    spent = dict.fromkeys(PARTS, 0.0)
    originals = {name: getattr(solver, name) for name in PARTS}

    def timed(name: str) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            began = time.process_time()
            try:
                return originals[name](*arguments)
            finally:
                spent[name] += time.process_time() - began

        return call

    for name in PARTS:
        setattr(solver, name, timed(name))
    try:
        yield spent
    finally:
        for name, function in originals.items():
            setattr(solver, name, function)


def elimination_flops(game: Game, nodes: int) -> float:
    """Operations of one block elimination: per interval an LU factorisation, half as many sides, and a product."""
    size = 2 * game.players * game.state_dim
    factor, sides, product = 2 / 3 * size**3, 2 * size**2 * (size / 2), 2 * size * (size / 2) ** 2
    return (nodes - 1) * (factor + sides + product)


def peak_flops(repeats: int, size: int = 1024) -> float:
    """Operations per second of a matrix product in single precision, in which the elimination is done."""
    matrix = torch.randn(size, size)
    return 2 * size**3 / seconds(lambda: matrix @ matrix, max(3, repeats))


def main() -> None:
    """Print the tables and one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--game", default="narrow_road")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    game, repeats, result = make(arguments.game), arguments.repeats, {}
    label_nodes = round(game.horizon / game.label_step) + 1
    tables = {
        "nodes": {label_nodes + e: (game, 64, Solver(extra_nodes=e)) for e in (30, 60, 120, 240, 480)},
        "starts": {n: (game, n, Solver()) for n in (32, 64, 128, 256, 512)},
        "states per player": {2 * d: (PointMasses(d), 64, Solver()) for d in (2, 3, 4, 6)},
    }
    for name, cases in tables.items():
        result[name] = {size: label_seconds(*case, repeats) for size, case in cases.items()}
        print(f"{name:20}" + "".join(f"{size:10}" for size in cases))
        print(f"{'ms per label':20}" + "".join(f"{1e3 * s:10.1f}" for s in result[name].values()), flush=True)
    with taken_apart() as spent:
        whole = label_seconds(game, 128, Solver(), 1) * 128
    print("where the time goes: " + ", ".join(f"{name} {part / whole:.0%}" for name, part in spent.items()))
    flops, peak = elimination_flops(game, label_nodes + Solver().extra_nodes), peak_flops(repeats)
    limit = 1e3 * flops / peak
    print(f"one elimination: {flops / 1e6:.2f} Mflop, {limit:.3f} ms at the peak of {peak / 1e9:.0f} Gflop/s")
    print(json.dumps({**result, "shares": {k: v / whole for k, v in spent.items()}, "elimination_ms": limit}))


if __name__ == "__main__":
    main()
