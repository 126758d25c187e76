"""Labels that were not solved, for tests that need many types, failures or chosen clearances."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from hno.control import Policy, as_policy
from hno.control.rollout import Disturbance, Player
from hno.evaluation.closed_loop import TypeRow, collision_table, play
from hno.evaluation.outcome import numbers_of
from hno.evaluation.sections import Evaluation
from hno.games import Game
from hno.operators import Architecture, Choice
from hno.pontryagin.mesh import label_times
from hno.pontryagin.solve import Solver
from hno.types import Extremal, Field, Points, Status, join


def fake_labels(
    game: Game,
    theta: Sequence[float] = (1.0, 1.0),
    count: int = 4,
    seed: int = 0,
    status: Sequence[Status] | None = None,
    clearance: Sequence[float] | None = None,
    start: Tensor | None = None,
) -> Extremal:
    """Random states of the PDE box with random values and costates, on the label grid of a game.

    Args:
        game: the game.
        theta: type of all rows.
        count: number of rows.
        seed: of everything random.
        status: of each row; converged by default.
        clearance: of each row, m; 1 by default.
        start: first state of each row, (count, P, n).
    """
    generator = torch.Generator().manual_seed(seed)
    t = label_times(game, dtype=torch.float64, device=torch.device("cpu"))
    nodes, players, states = len(t), game.players, game.state_dim

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    x = game.state_box.sample(count * nodes, generator).double().unflatten(0, (count, nodes))
    if start is not None:
        x[:, 0] = start
    value = -normal(count, nodes, players).abs()
    return Extremal(
        status=torch.tensor([int(s) for s in status or [Status.CONVERGED] * count]),
        residual=normal(count).abs(),
        t=t,
        x=x,
        costate=normal(count, nodes, players, players, states),
        u=normal(count, nodes, players, game.control_dim),
        value=value,
        theta=torch.tensor(theta, dtype=torch.float64).expand(count, -1).contiguous(),
        potential=value.sum(-1),
        start=torch.arange(count),
        clearance=torch.tensor(clearance or [1.0] * count, dtype=torch.float64),
        reintegration=normal(count).abs() * 1e-6,
        local_gap=normal(count, players).abs() * 1e-6,
        global_gap=normal(count, players).abs() * 1e-6,
        alternatives=normal(count, 3),
    )


def fake_solve(
    game: Game, x0: Tensor, theta: Tensor, settings: Solver = Solver(), *, all_equilibria: bool = False
) -> Extremal:
    """Fake labels in the place of `hno.pontryagin.solve.solve`; every row is a function of its start state and type."""
    seeds = [int.from_bytes(hashlib.sha256(start.numpy().tobytes()).digest()[:4]) for start in x0]
    rows = zip(theta.tolist(), seeds, x0, strict=True)
    return join([fake_labels(game, types, 1, seed, start=start) for types, seed, start in rows])


def small_architecture(
    activation: str = "tanh", width: int = 16, depth: int = 2, exact_terminal: bool = True, members: int = 1
) -> Architecture:
    """What a small operator is built of."""
    return Architecture(
        Choice("value", {"exact_terminal": exact_terminal, "members": members}),
        Choice("deeponet", {"width": width, "depth": depth}),
        Choice(activation),
    )


def nothing(points: Points) -> Field:
    """The field of a value function that is 0 everywhere."""
    zero = torch.zeros_like(points.theta)
    return Field(zero, zero, zero[..., None, None] * points.x.unsqueeze(-3))


class Controller(Policy):
    """A policy that stands where an evaluation has a learned one: with its game and a value function."""

    def __init__(self, game: Game, policy: Player, field: Callable[[Points], Field] = nothing) -> None:
        self.game, self.policy, self.operator = game, as_policy(policy), SimpleNamespace(field=field)

    def act(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        return self.policy.act(tau, x, theta)


def evaluation_of(
    game: Game, policy: Player, labels: Sequence[Extremal], field: Callable[[Points], Field] = nothing, **entries: Any
) -> Evaluation:
    """The evaluation of any policy from the starts of labels, before its episodes are played.

    Args:
        game: the game.
        policy: feedback controls of all players.
        labels: one set per type, and those of every condition.
        field: its value function.
        entries: of the configuration, or fields of the evaluation.
    """
    controller: Any = policy if hasattr(policy, "operator") else Controller(game, policy, field)
    known = {name: entries.pop(name) for name in Evaluation._fields if name in entries}
    types = [tuple(found.theta[0].tolist()) for found in labels if len(found.theta)]
    options = {"clearance": 0.02, "dt": 0.02, "seed": 0, **entries}
    return Evaluation("any", controller, (), types, options, lambda condition: labels, labels)._replace(**known)


def evaluated(
    game: Game, policy: Player, labels: Sequence[Extremal], seen: Sequence[Any] = (), **entries: Any
) -> Evaluation:
    """The same with episodes."""
    disturbance = entries.pop("disturbance", Disturbance())
    found = evaluation_of(game, policy, labels, seen=seen, **entries)
    played = play(game, found.policy, labels, found.dt, disturbance)
    return found._replace(played=[numbers_of(game, *one) for one in played])


def played_table(
    game: Game, policy: Player, labels: Sequence[Extremal], seen: Sequence[Any], **entries: Any
) -> list[TypeRow]:
    """What comes of a policy from the starts of labels."""
    return collision_table(evaluated(game, policy, labels, seen, **entries))
