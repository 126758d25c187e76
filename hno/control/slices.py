"""Slices: what a controller says on a grid over two coordinates of the joint state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hno.games import Axis, Game, Plane
from hno.games.plane import Coordinate
from hno.types import Numbers, Points

if TYPE_CHECKING:
    from hno.control.policy import Feedback

POINTS = 41
"""Points along each side of a grid, by default."""
AxisLike = str | Axis | tuple[str, float, float]
"""A coordinate, or one with the ends of what is shown of it."""


class Side(NamedTuple):
    """One side of a grid."""

    name: str
    """Of the coordinate."""
    unit: str
    values: NDArray[np.float64]
    """Rising, (A,) or (U,)."""

    @property
    def label(self) -> str:
        """Name and unit, for an axis of a picture."""
        return f"{self.name}, {self.unit}" if self.unit else self.name


class Slice(NamedTuple):
    """A grid of U rows, upwards, and A columns, and what a controller says there."""

    across: Side
    up: Side
    tau: float
    """Time to go, s."""
    theta: tuple[float, ...]
    """Player types."""
    x: NDArray[np.float64]
    """Joint states, (U, A, P, n)."""
    value: NDArray[np.float64]
    """V_i, (U, A, P)."""
    potential: NDArray[np.float64] | None
    """W, (U, A); None of a controller that has none."""
    costate: NDArray[np.float64]
    """dV_i / dx_j, (U, A, P, P, n), or dW / dx_j, (U, A, 1, P, n)."""
    control: NDArray[np.float64]
    """(U, A, P, m)."""
    constraint: NDArray[np.float64]
    """Below 0 where safe, (U, A, P, C)."""

    @property
    def violation(self) -> NDArray[np.float64]:
        """The largest constraint of all players, (U, A): its zero level is the boundary of the violation set."""
        return self.constraint.max((-1, -2))


class Grid(NamedTuple):
    """Where a slice is taken."""

    sides: tuple[Side, Side]
    x: Tensor
    """Joint states, (U, A, P, n), float64."""


def grid(game: Game, plane: Plane, points: int) -> Grid:
    """The joint states of a plane.

    Raises:
        ValueError: a coordinate that the game does not have or that another one moves, an empty range, too few points.
    """
    if points < 2:
        raise ValueError(f"points are those along each side of the grid, at least 2; got {points}.")
    axes = [(game.coordinate(axis.name), axis) for axis in (plane.across, plane.up)]
    placed = {name: game.coordinate(name) for name in plane.at}
    _check_apart([coordinate for coordinate, _ in axes], list(placed.values()))
    sides = [_side(coordinate, axis, points) for coordinate, axis in axes]
    x = game.base_state()
    for name, coordinate in placed.items():
        x = coordinate.put(x, float(plane.at[name]))
    up, across = torch.meshgrid(*(torch.from_numpy(side.values) for side in reversed(sides)), indexing="ij")
    x = axes[1][0].put(axes[0][0].put(x, across), up)
    return Grid((sides[0], sides[1]), x)


def _check_apart(axes: Sequence[Coordinate], placed: Sequence[Coordinate]) -> None:
    """Refuse coordinates that move each other: whichever is set last would win."""
    chosen = [*axes, *placed]
    for k, one in enumerate(chosen):
        for other in chosen[k + 1 :]:
            if float((one.weights * other.weights).sum()) != 0:
                raise ValueError(
                    f"A slice cannot have both {one.name!r} and {other.name!r}: to change one changes the other."
                )


def _side(coordinate: Coordinate, axis: Axis, points: int) -> Side:
    lo = coordinate.lo if axis.lo is None else float(axis.lo)
    hi = coordinate.hi if axis.hi is None else float(axis.hi)
    if not (np.isfinite([lo, hi]).all() and lo < hi):
        raise ValueError(f"The axis {axis.name!r} must run from a number to a larger one; got {lo:g} to {hi:g}.")
    return Side(coordinate.name, coordinate.unit, np.linspace(lo, hi, points))


def chosen_plane(game: Game, across: AxisLike | None, up: AxisLike | None, at: Mapping[str, float] | None) -> Plane:
    """The game's own plane, or another one.

    Raises:
        ValueError: one of two coordinates alone, or an axis that is none.
    """
    if across is None and up is None:
        plane = game.default_plane()
        return plane._replace(at={**plane.at, **(at or {})})
    if across is None or up is None:
        raise ValueError("A slice has two coordinates: give `across` and `up`, or none for the game's own slice.")
    return Plane(_axis(across), _axis(up), at or {})


def _axis(given: AxisLike) -> Axis:
    if isinstance(given, str):
        return Axis(given)
    if isinstance(given, (tuple, list)) and len(given) == 3:
        return Axis(*given)
    raise ValueError(f"An axis is the name of a coordinate, or (name, from, to); got {given!r}.")


def middle_types(game: Game) -> tuple[float, ...]:
    """The middle of the type box."""
    return tuple(((game.type_box.lo + game.type_box.hi) / 2).tolist())


def take(policy: Feedback, plane: Plane, theta: Numbers | None, tau: float | None, points: int) -> Slice:
    """What a policy says on a plane. Raises as `grid` and `Feedback.act`."""
    game = policy.game
    sides, x = grid(game, plane, points)
    theta = middle_types(game) if theta is None else theta
    types = torch.as_tensor(theta, dtype=torch.float64)
    at = Points(torch.full(x.shape[:2], game.horizon / 2 if tau is None else float(tau), dtype=x.dtype), x, types)
    found = {name: getattr(policy, name)(*at) for name in ("value", "costate")} | {"control": policy.act(*at)}
    potential = policy.potential(*at) if policy.operator.potential else None
    like = game.state_box.lo
    constraint = game.constraint(x.to(like), types.to(like).expand(*x.shape[:2], -1))
    arrays: dict[str, Any] = {name: _array(part) for name, part in found.items()}
    return Slice(
        *sides, float(at.tau[0, 0]), tuple(types.tolist()), _array(x), constraint=_array(constraint),
        potential=None if potential is None else _array(potential), **arrays,
    )  # fmt: skip


def _array(part: Tensor) -> NDArray[np.float64]:
    return part.detach().cpu().double().numpy()
