"""How much faster a training step is than one written the published way, on the same rows and weights.

    python benchmarks/step.py [--game narrow_road] [--rows 16384 2048] [--repeats 15] [--compile]

The baseline runs the branch for every row, takes one second-order autograd pass per player, loops over types and steps
Adam with its default settings. Half of the rows carry labels, three eighths are collocation points, one eighth is at
the terminal time; batches are in memory before the clock starts. Gradients of both are compared first, relative to
each tensor's largest entry.
"""

from __future__ import annotations

import argparse
import copy
import json
import statistics
import time
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from hno.games import make
from hno.losses import View, hji_residual, make_objective
from hno.losses.hji import HJIResidual
from hno.operators import Architecture, Choice, ValueOperator, make_operator
from hno.operators.inputs import ego_views
from hno.training.module import TrainingModule
from hno.types import Batch, Field, Labels, Points, Sample, Types

ARCHITECTURE = Architecture(Choice("value", {"exact_terminal": False}), activation=Choice("tanh"))
"""The paper's."""
WEIGHTS = {"value": 1.0, "costate": 1.0, "boundary": 1.0, "residual": 1.0}
TYPES = torch.tensor([[1.0, 1], [1, 5], [5, 1], [5, 5], [1, 3], [3, 3], [3, 5]])


def random_batch(operator: ValueOperator, rows: int, seed: int = 0) -> Batch:
    """Rows of all three streams, uniform in the PDE box."""
    game, generator, batch = operator.game, torch.Generator().manual_seed(seed), Batch()
    for stream, size in {"bvp": rows // 2, "interior": 3 * rows // 8, "terminal": rows // 8}.items():
        which = torch.arange(size) % len(TYPES)
        tau = (stream != "terminal") * game.horizon * torch.rand(size, generator=generator)
        points = Points(tau, game.state_box.sample(size, generator), TYPES[which])
        costate = torch.randn(size, game.players, game.players, game.state_dim, generator=generator)
        labels = Labels(torch.randn(size, game.players, generator=generator), costate)
        batch[stream] = Sample(points, labels if stream == "bvp" else None, Types(TYPES, which))
    return batch


def published_field(operator: ValueOperator, points: Points) -> Field:
    """Values and derivatives player by player, from a branch and an autograd pass of second order for each."""
    game, net = operator.game, operator.networks[0]
    tau, x, theta = points
    values, slopes, costates = [], [], []
    for player in range(game.players):
        own = tau.clone().requires_grad_()
        state = x.clone().requires_grad_()
        views = ego_views(game.state_box.scale(state))[:, player].unbind(1)
        time = (2 * own / game.horizon - 1).unsqueeze(-1)
        role = [torch.full_like(time, game.roles[player])] * (len(set(game.roles)) > 1)
        trunk = tanh_net(net.trunk, torch.cat([time, *views, *role], -1))
        value = (trunk * tanh_net(net.branch, game.sensors(theta)[:, player])).sum(-1)
        slope, costate = torch.autograd.grad(value.sum(), (own, state), create_graph=True)
        values.append(value)
        slopes.append(slope)
        costates.append(costate)
    return Field(torch.stack(values, -1), torch.stack(slopes, -1), torch.stack(costates, -3))


def tanh_net(net: torch.nn.Module, z: Tensor) -> Tensor:
    """A fully connected net layer by layer."""
    *hidden, last = net.layers
    for layer in hidden:
        z = torch.tanh(10 * net.activation.slope * layer(z))
    return last(z)


def published_loss(operator: ValueOperator, batch: Batch) -> Tensor:
    """The loss of `TrainingModule.training_step`, stream by stream and type by type."""
    total = torch.zeros_like(operator.value_scale)
    for stream, sample in batch.items():
        field = published_field(operator, sample.points)
        rows = len(sample.points.tau)
        for theta in TYPES:
            mine = (sample.points.theta == theta).all(-1)
            part = Field(*(p[mine] for p in field))
            share = mine.sum() / rows
            for name in TERMS[stream]:
                found = residual(operator, name, sample.rows(mine), part)
                total = total + WEIGHTS[name] * share * found.abs().mean()
    return total


TERMS = {"bvp": ("value", "costate"), "interior": ("residual",), "terminal": ("boundary",)}
"""Loss terms by the stream that they read."""


def residual(operator: ValueOperator, name: str, sample: Sample, field: Field) -> Tensor:
    """Scaled residual of one term for some rows."""
    game, scales, points = operator.game, operator.scales, sample.points
    if name == "residual":
        view = View(game, operator.problem, sample, field, lambda at: published_field(operator, at), scales, 0)
        return hji_residual(game, points, field) / HJIResidual().scale(view)
    if name == "boundary":
        return (field.value - game.terminal_value(points.x)) / scales.value
    assert sample.labels is not None
    if name == "value":
        return (field.value - sample.labels.value) / scales.value
    return (field.costate - sample.labels.costate) / scales.costate


def step(loss: Callable[[], Tensor], optimizer: torch.optim.Optimizer) -> None:
    """One step."""
    optimizer.zero_grad()
    loss().backward()
    optimizer.step()
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()


def seconds(run: Callable[[], object]) -> float:
    """Wall-clock time of one call."""
    began = time.perf_counter()
    run()
    return time.perf_counter() - began


def gradients(operator: ValueOperator, loss: Callable[[], Tensor]) -> Iterator[Tensor]:
    """Of every parameter."""
    operator.zero_grad()
    loss().backward()
    for parameter in operator.parameters():
        assert parameter.grad is not None
        yield parameter.grad.clone()


def difference(ours: Iterator[Tensor], theirs: Iterator[Tensor]) -> float:
    """Largest difference of two lists of gradients, relative to each tensor's largest entry."""
    return max(float((a - b).abs().max() / b.abs().max()) for a, b in zip(ours, theirs, strict=True))


def measure(name: str, rows: int, repeats: int, device: torch.device, *, compiles: bool) -> dict[str, float]:
    """Medians of both steps, alternating."""
    torch.manual_seed(0)
    objective = make_objective({term: {} for term in WEIGHTS}, WEIGHTS)
    module = TrainingModule(make_operator(make(name), ARCHITECTURE), objective).to(device)
    module.log_dict = module.log = lambda *_, **__: None  # type: ignore[method-assign]  # there is no trainer to log to
    ours, theirs = module.operator, copy.deepcopy(module.operator)
    if compiles:
        ours.compile_kernels()
    batch = module.transfer_batch_to_device(random_batch(ours, rows), device, 0)
    losses = (lambda: published_loss(theirs, batch)), (lambda: module.training_step(batch, 0))
    error = difference(gradients(ours, losses[1]), gradients(theirs, losses[0]))
    adam, fused = torch.optim.Adam(theirs.parameters()), torch.optim.Adam(ours.parameters(), fused=True)
    runs = (lambda: step(losses[0], adam)), (lambda: step(losses[1], fused))
    for run in runs:
        run()
    times = [[seconds(run) for run in runs] for _ in range(repeats)]
    baseline, fast = (statistics.median(column) for column in zip(*times, strict=True))
    return {"rows": rows, "ratio": baseline / fast, "baseline_s": baseline, "ours_s": fast, "difference": error}


def main() -> None:
    """Print the table and one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--game", default="narrow_road")
    parser.add_argument("--rows", type=int, nargs="+", help="16384 and 2048; 16 times as many on a GPU")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--compile", action="store_true", help="compile our step, not the baseline")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    device, compiles = torch.device(arguments.device), arguments.compile
    sizes = arguments.rows or [(1 if device.type == "cpu" else 16) * rows for rows in (16384, 2048)]
    found = [measure(arguments.game, n, arguments.repeats, device, compiles=compiles) for n in sizes]
    print(f"{'rows':>8s}{'published':>14s}{'ours':>14s}{'ratio':>8s}{'rows/s':>12s}{'gradients differ by':>22s}")
    for row in found:
        each = [1e6 * row[which] / row["rows"] for which in ("baseline_s", "ours_s")]
        text = f"{each[0]:>8.1f} us/row{each[1]:>8.1f} us/row{row['ratio']:>8.2f}{row['rows'] / row['ours_s']:>12,.0f}"
        print(f"{row['rows']:>8.0f}{text}{row['difference']:>22.0e}")
    print(json.dumps({"ratio": min(row["ratio"] for row in found), "threads": 1, "sizes": found}))


if __name__ == "__main__":
    main()
