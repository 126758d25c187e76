"""Loss terms: an unreduced residual, the stream it reads and the size it is measured in."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import ClassVar, NamedTuple

from torch import Tensor, nn

from hno.games import Game
from hno.games.potential import Problem
from hno.registry import Registry
from hno.types import Field, Points, PotentialField, Sample

losses: Registry[LossTerm] = Registry("loss", "hno.losses", base="hno.losses.base:LossTerm")

STREAMS = frozenset({"bvp", "interior", "terminal"})
"""Labelled rows, collocation points inside the window, and points at tau = 0."""


class Scales(NamedTuple):
    """Typical sizes of values and costates, which make weights comparable between games."""

    value: Tensor
    """Of V_i, scalar."""
    costate: Tensor
    """Of dV_i / dx_j, (P, P, n), or of dW / dx_j, (1, P, n)."""


class View(NamedTuple):
    """What a loss term sees of a training step."""

    game: Game
    problem: Problem
    """Whose Hamilton-Jacobi equation it is: the game, or its `Team` where a potential is learned."""
    sample: Sample
    """The rows of the term's stream, B of them."""
    field: Field | PotentialField
    """The operator at these rows, differentiable in its parameters."""
    at: Callable[[Points], Field | PotentialField]
    """The operator at any other points, differentiable in its parameters."""
    scales: Scales
    step: int
    """Training steps that were taken before this one."""


class LossTerm(nn.Module, abc.ABC):
    """One term of a loss. Constructor arguments are options; weighting and reduction belong to `Objective`."""

    stream: ClassVar[str]
    """The data stream that the term reads, one of `STREAMS`."""
    met_by_exact_terminal: ClassVar[bool] = False
    """Whether it vanishes, so that nothing has to read it, where the terminal condition holds by construction."""

    @abc.abstractmethod
    def residual(self, view: View) -> Tensor:
        """Zero where the term is satisfied, shape (B, ...)."""

    @abc.abstractmethod
    def scale(self, view: View) -> Tensor:
        """Size that makes the residual dimensionless, broadcastable to it."""
