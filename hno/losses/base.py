"""Loss terms: an unreduced residual, the streams it reads and the size it is measured in."""

from __future__ import annotations

import abc
import math
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from hno.games import Game
from hno.registry import Registry
from hno.types import Field, Sample

losses: Registry[LossTerm] = Registry("loss", "hno.losses")

STREAMS = frozenset({"bvp", "interior", "terminal"})
"""Labelled rows, collocation points inside the window, and points at tau = 0."""


class Scales(NamedTuple):
    """Typical sizes of labels, which make weights comparable between games."""

    value: Tensor
    """Of V_i, scalar."""
    costate: Tensor
    """Of dV_i / dx_j, (P, P, n)."""


class LossTerm(nn.Module, abc.ABC):
    """One term of an operator's loss. Weighting and reduction are the operator's job."""

    stream: ClassVar[str]
    """The data stream that the term reads, one of `STREAMS`."""
    met_by_exact_terminal: ClassVar[bool] = False
    """Whether it vanishes, so that nothing has to read it, where the terminal condition holds by construction."""

    @abc.abstractmethod
    def residual(self, game: Game, sample: Sample, field: Field) -> Tensor:
        """Zero where the term is satisfied, shape (B, P, ...)."""

    @abc.abstractmethod
    def scale(self, game: Game, sample: Sample, scales: Scales) -> Tensor:
        """Size that makes the residual dimensionless, broadcastable to it."""


def used_weights(
    terms: Mapping[str, type[LossTerm]], weights: Mapping[str, float] | None, *, exact_terminal: bool
) -> dict[str, float]:
    """Weights of the terms that an operator reads, by name.

    Args:
        terms: of the operator.
        weights: of any terms; those of others are ignored, and 1 each by default.
        exact_terminal: leave out the terms that then vanish.

    Raises:
        ValueError: a weight is not finite or negative, or none is left that counts.
    """
    given = {name: float(w) for name, w in (weights or dict.fromkeys(terms, 1.0)).items() if name in terms}
    used = {name: w for name, w in given.items() if not (exact_terminal and terms[name].met_by_exact_terminal)}
    if not all(math.isfinite(w) and w >= 0 for w in given.values()) or not any(used.values()):
        raise ValueError(
            f"Loss weights must be finite, not negative and not all 0; got {given}. With an exact terminal condition "
            "the boundary does not count."
        )
    return used


class Norm(nn.Module):
    """Mean of a pointwise norm of a dimensionless residual.

    Args:
        kind: "l1" (paper, eq. 6), "l2" or "huber" (quadratic below 1).

    Raises:
        ValueError: unknown kind.
    """

    kinds: ClassVar[tuple[str, ...]] = ("huber", "l1", "l2")

    def __init__(self, kind: str = "l1") -> None:
        super().__init__()
        if kind not in self.kinds:
            raise ValueError(f"The loss norm must be one of {', '.join(self.kinds)}; got {kind!r}.")
        self.kind = kind

    def forward(self, residual: Tensor) -> Tensor:
        """Scalar mean."""
        if self.kind == "l1":
            return residual.abs().mean()
        if self.kind == "l2":
            return residual.square().mean()
        return nn.functional.huber_loss(residual, torch.zeros_like(residual))
