"""What a controller is asked: as people ask it, and whether it has an answer."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hno.games import Game
from hno.types import ROUNDING, Numbers, Points, tensor_of

X = TypeVar("X", Tensor, NDArray[Any])
"""Tensors or arrays: answers are of the kind of the states."""


class Question(NamedTuple):
    """A question in the type and on the device of an operator, and how its answer is given back."""

    points: Points
    """The states in one row, (B,), (B, P, n), (B, P)."""
    asked: Any
    """The states as they came."""
    batch: torch.Size
    """Their leading shape, () for one state."""

    def answered(self, found: Tensor) -> Any:
        """An answer (B, ...) in the shape, the kind and the floating-point type of the states, (*batch, ...)."""
        found = found.reshape((*self.batch, *found.shape[1:]))
        if isinstance(self.asked, Tensor):
            return in_type_of(self.asked, found.to(self.asked.device))
        if not isinstance(self.asked, np.ndarray):
            return found
        array = found.detach().cpu().numpy()
        return array.astype(self.asked.dtype) if {array.dtype.kind, self.asked.dtype.kind} == {"f"} else array


def in_type_of(x: Tensor, found: Tensor) -> Tensor:
    """What was found in the floating-point type of x, if both have one."""
    return found.to(x.dtype) if x.is_floating_point() and found.is_floating_point() else found


def question(game: Game, tau: Numbers, x: Numbers, theta: Numbers, like: Tensor) -> Question:
    """A question, checked.

    Args:
        game: the game.
        tau: times to go, (*batch,), or one for all states.
        x: states, (*batch, P, n) with any leading shape, () and (0,) too.
        theta: types, (*batch, P), or one (P,) for all states.
        like: whose type and device the points get.

    Raises:
        ValueError: shapes do not fit the game or each other, an entry is not finite, or a time to go is not within the
            horizon.
    """
    given = tensor_of("tau", tau), tensor_of("x", x), tensor_of("theta", theta)
    times, states, types = (part.to(like) for part in given)
    batch, joint = states.shape[:-2], (game.players, game.state_dim)
    fits = states.dim() >= 2 and states.shape[-2:] == joint and times.shape in (batch, ())
    if not (fits and types.shape in ((*batch, joint[0]), joint[:1])):
        raise ValueError(
            f"Expected tau (B,), x (B, {joint[0]}, {joint[1]}) and theta (B, {joint[0]}), or tau (), x {joint} and "
            f"theta ({joint[0]},) of one state; got {', '.join(str(tuple(part.shape)) for part in given)}."
        )
    game.check_theta(types)
    if not bool(times.isfinite().all() & states.isfinite().all()):
        raise ValueError("tau and x must be finite; a controller has no answer to NaN or infinite entries.")
    margin = ROUNDING * game.horizon
    if not bool(((times >= -margin) & (times <= game.horizon + margin)).all()):
        raise ValueError(
            f"tau is the time to go, from 0 to the horizon of {game.horizon:g} s; got {float(times.min()):g} to "
            f"{float(times.max()):g} s."
        )
    flat = times.expand(batch).reshape(-1), states.reshape(-1, *joint), types.expand(*batch, -1).reshape(-1, joint[0])
    return Question(Points(*flat), x, batch)


def outside(game: Game, x: Tensor) -> Tensor:
    """Whether states lie outside the PDE box, up to rounding, (..., P, n) -> (...); those that wrap around never do."""
    beyond = (game.state_box.scale(x).abs() > 1 + 2 * ROUNDING) | ~x.isfinite()
    beyond[..., list(game.periodic)] = False
    return beyond.flatten(-2).any(-1)


def starts(game: Game, x0: Numbers, theta: Numbers) -> tuple[Tensor, Tensor]:
    """Start states (B, P, n) and their types (B, P), or one (P,) for all, checked, in the game's floating-point type.

    Raises:
        ValueError: shapes do not fit the game or each other, or an entry is not finite.
    """
    states, types = tensor_of("x0", x0), tensor_of("theta", theta)
    joint = game.players, game.state_dim
    if states.dim() != 3 or states.shape[1:] != joint or types.shape not in ((len(states), joint[0]), joint[:1]):
        raise ValueError(
            f"Expected x0 (B, {joint[0]}, {joint[1]}) and theta (B, {joint[0]}), or theta ({joint[0]},) for all; got "
            f"{tuple(states.shape)} and {tuple(types.shape)}."
        )
    for name, part in (("x0", states), ("theta", types)):
        if not bool(part.isfinite().all()):
            raise ValueError(f"{name} has entries that are not finite: no episode starts there.")
    states = states.to(game.state_box.lo.dtype)
    return states, types.to(states).expand(len(states), -1)
