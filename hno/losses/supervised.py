"""Terms that compare with Pontryagin labels (paper, eq. 6, third and fourth sums)."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from hno.losses.base import LossTerm, View, losses
from hno.types import Labels, PotentialField, PotentialLabels


def _labels(view: View) -> Labels | PotentialLabels:
    if view.sample.labels is None:
        raise ValueError("A supervised term needs the labelled stream 'bvp'; this sample has points only.")
    return view.sample.labels


@final
@losses.register("value")
class ValueDeviation(LossTerm):
    """Predicted minus labelled value; where that is a potential's, the players' values too."""

    stream = "bvp"

    def residual(self, view: View) -> Tensor:
        """(B, P), or (B, 1 + P) of a potential."""
        labels, field = _labels(view), view.field
        off = field.value - labels.value
        if isinstance(labels, PotentialLabels) and isinstance(field, PotentialField):
            return torch.cat([off, field.players - labels.players], -1)
        return off

    def scale(self, view: View) -> Tensor:
        """Size of values."""
        return view.scales.value


@final
@losses.register("costate")
class CostateDeviation(LossTerm):
    """Predicted minus labelled costate."""

    stream = "bvp"

    def residual(self, view: View) -> Tensor:
        """(B, Q, P, n)."""
        return view.field.costate - _labels(view).costate

    def scale(self, view: View) -> Tensor:
        """Size of each costate component."""
        return view.scales.costate


@final
@losses.register("branches")
class OtherBranches(LossTerm):
    """How far any other branch of a potential exceeds the best equilibrium, which would be played in its place.

    It is 0 for a value function without branches.
    """

    stream = "bvp"

    def residual(self, view: View) -> Tensor:
        """(B, branches)."""
        labels, field, types = _labels(view), view.field, view.sample.types
        if not isinstance(labels, PotentialLabels) or not isinstance(field, PotentialField):
            return torch.zeros_like(field.value)
        assert types is not None
        assert types.branch is not None
        branches = field.branches
        own = torch.arange(branches.shape[-1], device=branches.device) == types.branch.unsqueeze(-1)
        counts = labels.best.unsqueeze(-1) & ~own
        return (branches - labels.value).clamp_min(0) * counts

    def scale(self, view: View) -> Tensor:
        """Size of values."""
        return view.scales.value
