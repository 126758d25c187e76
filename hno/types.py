"""Tuples that fix every shape of the package.

P players, n states and m controls per player, K time nodes, any leading batch shape B.
Quantities are in physical units; `tau` is time to go (0 is terminal), `t` runs forward.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Numbers = Tensor | NDArray[Any] | Sequence[Any] | float
"""What people hand over: tensors, arrays, nested lists and numbers."""
ROUNDING = 1e-5
"""How far a time to go or a state may lie outside its range, relative to the range."""


def tensor_of(name: str, numbers: Numbers) -> Tensor:
    """A tensor as it is; arrays, lists and numbers as a floating-point one.

    Raises:
        ValueError: they are no real numbers, or rows have different lengths.
    """
    if isinstance(numbers, Tensor):
        found = numbers
    else:
        try:
            array = np.asarray(numbers)
        except ValueError:  # of different lengths
            array = np.array(None)
        if array.dtype.kind not in "fiu":
            raise ValueError(f"{name} must be a tensor or an array of real numbers; got {numbers!r:.80}.")
        single = array.dtype in (np.float16, np.float32)
        found = torch.from_numpy(np.array(array, dtype=np.float32 if single else np.float64))
    if found.is_complex() or found.dtype == torch.bool:
        raise ValueError(f"{name} must be real numbers; got {found.dtype}.")
    return found if found.is_floating_point() else found.double()


class Points(NamedTuple):
    """Where a value function is asked: time to go, joint state, player types."""

    tau: Tensor
    """Time to go, s, shape (B,)."""
    x: Tensor
    """Joint state, shape (B, P, n)."""
    theta: Tensor
    """Player types, shape (B, P)."""


class Types(NamedTuple):
    """Player types of some points as a table, so that nothing has to search for equal ones on a device."""

    distinct: Tensor
    """Different types, shape (C, P)."""
    which: Tensor
    """Row of the table of each point, int64, shape (B,)."""
    branch: Tensor | None = None
    """Branch of a potential at each point, -1 for the best one, int64, shape (B,); None for the best one everywhere."""

    def rows(self, index: Tensor) -> Types:
        """Some of the points."""
        return self._replace(which=self.which[index], branch=None if self.branch is None else self.branch[index])


class Labels(NamedTuple):
    """What an operator is supervised with, at the points of the same row."""

    value: Tensor
    """V_i = -J_i, shape (B, P)."""
    costate: Tensor
    """dV_i / dx_j, shape (B, P, P, n)."""


class PotentialLabels(NamedTuple):
    """What an operator of a potential is supervised with, at the points of the same row."""

    value: Tensor
    """W, shape (B, 1)."""
    costate: Tensor
    """dW / dx_j, shape (B, 1, P, n)."""
    players: Tensor
    """V_i, shape (B, P)."""
    best: Tensor
    """Whether no other equilibrium of the same start has a larger W, bool, shape (B,)."""


class Field(NamedTuple):
    """A value function and its derivatives at some points."""

    value: Tensor
    """V_i, shape (B, P)."""
    dvalue_dtau: Tensor
    """Derivative in time to go, 1/s, shape (B, P)."""
    costate: Tensor
    """dV_i / dx_j, shape (B, P, P, n)."""


class PotentialField(NamedTuple):
    """A potential and its derivatives at some points, which have the names of a value function's."""

    value: Tensor
    """W of the branch that is asked for or the best one, shape (B, 1)."""
    dvalue_dtau: Tensor
    """Derivative in time to go, 1/s, shape (B, 1)."""
    costate: Tensor
    """dW / dx_j, shape (B, 1, P, n)."""
    players: Tensor
    """V_i, shape (B, P)."""
    branches: Tensor
    """W of every branch, -inf for those that no label has, shape (B, branches)."""


class Sample(NamedTuple):
    """One stream of a training batch: points, and labels where the stream has them."""

    points: Points
    labels: Labels | PotentialLabels | None = None
    types: Types | None = None
    """The points' theta as a table; None where nobody has made one."""

    @property
    def size(self) -> int:
        """Number of rows."""
        return len(self.points.tau)

    def rows(self, index: Tensor) -> Sample:
        """Some of the rows."""
        return Sample(
            Points(*(column[index] for column in self.points)),
            None if self.labels is None else type(self.labels)(*(column[index] for column in self.labels)),
            None if self.types is None else self.types.rows(index),
        )


Batch = dict[str, Sample]
"""A training batch: stream name -> sample."""


def tables(parts: Sequence[Types]) -> Types:
    """One table for several batches of points, one after the other."""
    offsets = itertools.accumulate((len(part.distinct) for part in parts), initial=0)
    which = [part.which + offset for part, offset in zip(parts, offsets, strict=False)]
    branch = [torch.full_like(part.which, -1) if part.branch is None else part.branch for part in parts]
    known = any(part.branch is not None for part in parts)
    return Types(torch.cat([part.distinct for part in parts]), torch.cat(which), torch.cat(branch) if known else None)


def joined(samples: Sequence[Sample]) -> Sample:
    """Labelled samples of one kind, one after the other."""
    points, labels, types = zip(*samples, strict=True)
    columns = (torch.cat(parts) for parts in zip(*labels, strict=True))
    return Sample(Points(*map(torch.cat, zip(*points, strict=True))), type(labels[0])(*columns), tables(types))


class Status(IntEnum):
    """How a boundary value problem ended."""

    CONVERGED = 0
    STALLED = 1
    """The damped Newton step could not reduce the residual further."""
    MAX_STEPS = 2
    """The step budget ran out while the residual was still falling."""
    NOT_FINITE = 3
    """The states left the region where the game's functions are finite."""
    INACCURATE = 4
    """Solved on the mesh, but its controls do not lead where its states say."""

    @property
    def advice(self) -> str:
        """What it means and what to do about it."""
        return _ADVICE[self]


_ADVICE = {
    Status.CONVERGED: "the residual is below the tolerance: use it",
    Status.STALLED: "the residual stopped falling, mostly where controls saturate or a constraint has kinks: give "
    "every pair of players a constraint of its own, smooth it, or try hno.pontryagin.Solver(extra_nodes=120); players "
    "with opposed interests, as in pursuit, are beyond the search",
    Status.MAX_STEPS: "the residual was still falling: raise Solver(newton=Newton(steps=...))",
    Status.NOT_FINITE: "states or costates grew beyond bounds: check that dynamics and costs are finite around the PDE "
    "box, with hno.games.testing.check_game",
    Status.INACCURATE: "solved on the mesh, but its controls do not lead where its states say: raise "
    "Solver(extra_nodes=...)",
}


class Extremal(NamedTuple):
    """Trajectories that satisfy Pontryagin's conditions (paper, eq. 4), on a common time grid.

    A trajectory whose `status` is not `Status.CONVERGED` holds the last iterate and must not be used as a label.
    """

    status: Tensor
    """`Status` of each trajectory, int64, shape (B,)."""
    residual: Tensor
    """Largest scaled collocation residual, shape (B,)."""
    t: Tensor
    """Time nodes, s, shape (K,)."""
    x: Tensor
    """States, shape (B, K, P, n)."""
    costate: Tensor
    """dV_i / dx_j along the trajectory, shape (B, K, P, P, n)."""
    u: Tensor
    """Controls, shape (B, K, P, m)."""
    value: Tensor
    """V_i from t to the end, shape (B, K, P)."""
    theta: Tensor
    """Player types, shape (B, P)."""
    potential: Tensor
    """W from t to the end, see `hno.games.potential`; NaN where the game is no potential game, shape (B, K)."""
    start: Tensor
    """Which start state each trajectory belongs to, counted from 0, int64, shape (B,)."""
    clearance: Tensor
    """Smallest -constraint over players, their constraints and time, between the nodes too, shape (B,)."""
    reintegration: Tensor
    """Distance between its end and where its controls lead, in widths of the PDE box, (B,)."""
    local_gap: Tensor
    """What each player gains by re-optimising alone, from this trajectory, relative to its cost, (B, P)."""
    global_gap: Tensor
    """The same from several manoeuvres; above some 1e-3 the equilibrium is a local one, (B, P)."""
    alternatives: Tensor
    """Sum of values of every start that was tried, NaN where it did not converge, shape (B, starts)."""

    @property
    def cost(self) -> Tensor:
        """Joint cost of the whole game, shape (B,)."""
        return -self.value[:, 0].sum(-1)

    @property
    def starts(self) -> int:
        """Number of start states."""
        return int(self.start[-1]) + 1 if len(self.start) else 0


def join(parts: Sequence[Extremal]) -> Extremal:
    """Extremals of one game, one after the other; their starts are counted on."""
    batched = {name: torch.cat([getattr(part, name) for part in parts]) for name in Extremal._fields if name != "t"}
    before = list(itertools.accumulate((part.starts for part in parts), initial=0))
    start = torch.cat([part.start + offset for part, offset in zip(parts, before, strict=False)])
    return Extremal(t=parts[0].t, **{**batched, "start": start})


def part(found: Extremal, rows: slice | Tensor) -> Extremal:
    """Some rows of extremals."""
    return Extremal(**{name: column if name == "t" else column[rows] for name, column in found._asdict().items()})


def of_starts(found: Extremal, first: int, end: int | None = None) -> Extremal:
    """The extremals of the start states from `first` to before `end`, which are counted anew."""
    kept = part(found, (found.start >= first) & (found.start < (found.starts if end is None else end)))
    return kept._replace(start=kept.start - first)


def best_of(found: Extremal) -> Extremal:
    """One extremal per start state: the first, which is the best where `solve` found several."""
    new = found.start.diff(prepend=found.start.new_full((1,), -1)) != 0
    return part(found, new)


class Trajectory(NamedTuple):
    """A closed-loop simulation, on a common time grid."""

    t: Tensor
    """Time nodes, s, shape (K,)."""
    x: Tensor
    """States, shape (B, K, P, n)."""
    u: Tensor
    """Controls, held from each node to the next, shape (B, K - 1, P, m)."""
    value: Tensor
    """Minus the cost of the whole episode, shape (B, P)."""
    clearance: Tensor
    """Smallest -constraint over players, their constraints and time, between the nodes too, shape (B,)."""
    distance: Tensor
    """Smallest distance between the positions of two players over time, m, inf for one player, shape (B,)."""

    @property
    def cost(self) -> Tensor:
        """Joint cost of the whole episode, shape (B,)."""
        return -self.value.sum(-1)

    @property
    def collided(self) -> Tensor:
        """Which episodes collide, shape (B,): those that keep no positive clearance, and those that are lost."""
        return ~(self.clearance > 0) | self.lost

    @property
    def lost(self) -> Tensor:
        """Which episodes have states that are not finite, or a clearance or cost that is NaN, shape (B,)."""
        return ~self.x.flatten(1).isfinite().all(-1) | self.value.isnan().any(-1) | self.clearance.isnan()
