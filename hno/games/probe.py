"""What the checks of a game share: where they look, what they call, and how they complain."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from hno.games.base import Game, own_costate


class ContractError(AssertionError):
    """A game breaks the contract; the message says what was expected, what came and what to do."""


class Point(NamedTuple):
    """Arguments of a game's methods."""

    x: Tensor
    u: Tensor
    costate: Tensor
    theta: Tensor


def require(met: bool, expected: str, got: object, remedy: str) -> None:
    """Raise unless a promise is kept."""
    if not met:
        raise ContractError(f"Expected {expected}; got {got}. {remedy}")


def points(game: Game, shape: tuple[int, ...], dtype: torch.dtype, scale: float = 30.0, seed: int = 0) -> Point:
    """Random states of the PDE box, controls, costates of size `scale` and types, of a batch shape."""
    generator, size = torch.Generator().manual_seed(seed), torch.Size(shape).numel()
    x, box = game.state_box.sample(size, generator), game.control_box
    u = box.lo + box.width * torch.rand(size, game.players, game.control_dim, generator=generator)
    costate = scale * torch.randn(size, game.players, *x.shape[-2:], generator=generator)
    theta = game.type_box.sample(size, generator)
    return Point(*(part.unflatten(0, (*shape, 1)).squeeze(len(shape)).to(dtype) for part in (x, u, costate, theta)))


def methods(game: Game, at: Point) -> dict[str, tuple[Callable[[], Tensor], tuple[int, ...]]]:
    """Every method with its arguments, and the shape of its result after the batch shape, up to a free last axis."""
    players, states, controls = game.players, game.state_dim, game.control_dim
    return {
        "dynamics": (lambda: game.dynamics(at.x, at.u), (players, states)),
        "effort": (lambda: game.effort(at.u), (players,)),
        "terminal_value": (lambda: game.terminal_value(at.x), (players,)),
        "constraint": (lambda: game.constraint(at.x, at.theta), (players,)),
        "state_cost": (lambda: game.state_cost(at.x, at.theta), (players,)),
        "penalty": (lambda: game.penalty(at.x, at.theta), (players,)),
        "potential_cost": (lambda: game.potential_cost(at.x, at.theta), ()),
        "running_cost": (lambda: game.running_cost(at.x, at.u, at.theta), (players,)),
        "hamiltonian": (lambda: game.hamiltonian(at.x, at.costate, at.u, at.theta), (players,)),
        "best_response": (lambda: game.best_response(at.x, own_costate(at.costate)), (players, controls)),
        "optimal_control": (lambda: game.optimal_control(at.x, at.costate), (players, controls)),
        "violates": (lambda: game.violates(at.x, at.theta), ()),
        "sensors": (lambda: game.sensors(at.theta), (players,)),
        "positions": (lambda: game.positions(at.x), (players,)),
    }
