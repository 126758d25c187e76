"""What rows, nodes and players cost: labels, a training step and one answer of the policy, with fitted exponents.

    python benchmarks/scaling.py [--starts 4] [--repeats 3] [--players 2 3 4 6] [--nodes 20 40 80] [--rows 1024 4096]

The game is made here: P point masses cross one place from directions evenly around it, and every pair keeps its
distance. Labels are those of `hno.solve`, without all equilibria. A step is one of the method `hno` with its default
net, a function of each player's value, and Adam. One thread; batches are in memory before the clock starts.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from hno.control.policy import Feedback
from hno.games import Box, CollisionAvoidance, Game
from hno.games.kinematics import double_integrator_drift
from hno.losses import make_objective
from hno.operators import Architecture, Choice, make_operator
from hno.pontryagin.solve import solve
from hno.training.module import TrainingModule
from hno.types import Batch, Labels, Points, Sample, Types

WEIGHTS = {"value": 1.0, "costate": 1.0, "residual": 0.1}
SHARES = {"bvp": 0.75, "interior": 0.25}
"""Of the rows of a step, roughly those of the defaults."""


class Crossing(CollisionAvoidance):
    """Point masses (p, q, p', q'), each in the frame of its own direction.

    Args:
        players: how many.
        nodes: label intervals.
    """

    horizon = 2.0
    radius, first_sensor, sensor_count = 0.2, 0.2, 30

    def __init__(self, players: int = 2, nodes: int = 20) -> None:
        super().__init__()
        self.roles, self.label_step = tuple(range(players)), self.horizon / nodes
        self.state_box = Box([[-4, -3, -2, -4]] * players, [[9, 3, 6, 4]] * players)
        self.initial_box = Box([[-2.2, -0.2, 1.8, -0.1]] * players, [[-1.8, 0.2, 2.2, 0.1]] * players)
        self.control_box = Box([-4, -4], [4, 4])
        self.type_box = Box([0] * players, [2] * players)
        turn = 2 * math.pi * torch.arange(players) / players
        self.register_buffer("along", torch.stack([turn.cos(), turn.sin()], -1))
        self.register_buffer("across", torch.stack([-turn.sin(), turn.cos()], -1))
        self.register_buffer("input_matrix", torch.eye(4)[:, 2:])
        self.register_buffer("effort_weight", torch.ones(2))

    def drift(self, x: Tensor) -> Tensor:
        """Motion at constant velocity."""
        return double_integrator_drift(x)

    def positions(self, x: Tensor) -> Tensor:
        """In one frame, around the place where they meet."""
        return x[..., :1] * self.along + x[..., 1:2] * self.across

    def terminal_value(self, x: Tensor) -> Tensor:
        """On the line, at the speed of the beginning."""
        return -5 * x[..., 1].square() - (x[..., 2] - 2).square() - x[..., 3].square()


def seconds(run: Callable[[], object], repeats: int) -> float:
    """Median processor time of a call, after one that does not count: what else the machine does matters little."""
    times = []
    for _ in range(repeats + 1):
        began = time.process_time()
        run()
        times.append(time.process_time() - began)
    return statistics.median(times[1:])


def label_seconds(game: Game, starts: int) -> float:
    """Of one label, once; the share that converges is printed."""
    generator = torch.Generator().manual_seed(0)
    x0, theta = game.initial_box.sample(starts, generator).double(), torch.ones(starts, game.players).double()
    began = time.process_time()
    found = solve(game, x0, theta)
    spent = (time.process_time() - began) / starts
    print(
        f"{game.players} players, {len(found.t)} nodes: {int((found.status == 0).sum())} of {starts} converged",
        flush=True,
    )
    return spent


def batch_of(game: Game, rows: int) -> Batch:
    """Random rows of one type."""
    generator, batch = torch.Generator().manual_seed(0), Batch()
    for stream, share in SHARES.items():
        size = round(share * rows)
        points = Points(
            game.horizon * torch.rand(size, generator=generator), game.state_box.sample(size, generator),
            torch.ones(size, game.players),
        )  # fmt: skip
        shape = size, game.players, game.players, game.state_dim
        labels = Labels(torch.randn(shape[:2], generator=generator), torch.randn(shape, generator=generator))
        types = Types(torch.ones(1, game.players), torch.zeros(size, dtype=torch.int64))
        batch[stream] = Sample(points, labels if stream == "bvp" else None, types)
    return batch


def module_of(game: Game) -> TrainingModule:
    """What a step trains."""
    torch.manual_seed(0)
    operator = make_operator(game, Architecture(Choice("value"), activation=Choice("tanh")))
    module = TrainingModule(operator, make_objective({name: {} for name in WEIGHTS}, WEIGHTS))
    module.log_dict = module.log = lambda *_, **__: None  # type: ignore[method-assign]  # there is no trainer to log to
    return module


def step_seconds(game: Game, rows: int, repeats: int) -> float:
    """Of one step."""
    module, batch = module_of(game), batch_of(game, rows)
    optimizer = torch.optim.Adam(module.operator.parameters())

    def step() -> None:
        optimizer.zero_grad()
        module.training_step(batch, 0).backward()
        optimizer.step()

    return seconds(step, repeats)


def answer_seconds(game: Game, repeats: int) -> float:
    """Of the controls of all players in one state."""
    policy, theta = Feedback(module_of(game).operator), torch.ones(1, game.players)
    x = game.initial_box.sample(1, torch.Generator().manual_seed(0))
    return seconds(lambda: policy.act(torch.tensor([1.0]), x, theta), 20 * repeats)


def exponent(sizes: Sequence[int], costs: Sequence[float]) -> float:
    """Slope of a line through the logarithms."""
    return statistics.linear_regression([*map(math.log, sizes)], [*map(math.log, costs)]).slope


def rows_of(found: Mapping[str, Mapping[int, float]]) -> list[list[str]]:
    """Cells of the table: what grows, its sizes, the cost at each, and exponents over all and between the last two."""
    cells = []
    for name, costs in found.items():
        sizes, times = list(costs), list(costs.values())
        last = exponent(sizes[-2:], times[-2:])
        listed = ", ".join(f"{1e3 * each:,.3g}" for each in times)
        cells.append([name, ", ".join(map(str, sizes)), listed, f"{exponent(sizes, times):.2f}", f"{last:.2f}"])
    return cells


def main() -> None:
    """Print the table and one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--starts", type=int, default=4, help="of which labels are solved")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--players", type=int, nargs="+", default=[2, 3, 4, 6])
    parser.add_argument("--nodes", type=int, nargs="+", default=[20, 40, 80])
    parser.add_argument("--rows", type=int, nargs="+", default=[1024, 4096, 16384])
    given = parser.parse_args()
    torch.set_num_threads(1)
    crowds = {players: Crossing(players) for players in given.players}
    found = {
        "step, by rows": {rows: step_seconds(Crossing(), rows, given.repeats) for rows in given.rows},
        "step of 2048 rows, by players": {p: step_seconds(game, 2048, given.repeats) for p, game in crowds.items()},
        "answer, by players": {p: answer_seconds(game, given.repeats) for p, game in crowds.items()},
        "label, by nodes": {nodes: label_seconds(Crossing(2, nodes), given.starts) for nodes in given.nodes},
        "label, by players": {p: label_seconds(game, given.starts) for p, game in crowds.items()},
    }
    table = Table("cost of a", "sizes", "ms", "exponent", "of the last two")
    for cells in rows_of(found):
        table.add_row(*cells)
    Console(width=120).print(table)
    print(json.dumps({"threads": 1, "starts": given.starts, "seconds": found}))


if __name__ == "__main__":
    main()
