"""A method: loss terms and their weights, and how their residuals become one number."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from hno.losses.base import STREAMS, LossTerm, View, losses
from hno.registry import check_options


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


class Objective(nn.Module):
    """The weighted sum of loss terms, sum_k w_k mean |residual_k| (paper, eq. 6).

    Args:
        terms: by name.
        weights: one for each term, by the same names.
        norm: see `Norm`.
        scaled: measure residuals in the sizes that the terms state rather than in physical units.
        balance: divide every term by its own running mean, so that weights are shares of the gradient of the log loss.
        hardest: share of the collocation points that count, those of the largest residuals.

    Raises:
        ValueError: a weight without a term or a term without a weight; weights that are not finite, negative or all 0;
            a term that reads an unknown stream; `hardest` outside (0, 1].
    """

    running: Tensor
    """Running mean of each term, 0 before its first step."""

    def __init__(
        self,
        terms: Mapping[str, LossTerm],
        weights: Mapping[str, float],
        norm: str = "l1",
        scaled: bool = True,
        balance: bool = False,
        hardest: float = 1.0,
    ) -> None:
        super().__init__()
        if set(terms) != set(weights):
            raise ValueError(
                f"Every loss term needs a weight and every weight a term; got the terms {', '.join(sorted(terms))} and "
                f"weights of {', '.join(sorted(weights))}. Without their counterpart: "
                f"{', '.join(sorted(set(terms) ^ set(weights)))}."
            )
        self.weights = {name: float(weights[name]) for name in terms}
        if not all(math.isfinite(w) and w >= 0 for w in self.weights.values()) or not any(self.weights.values()):
            raise ValueError(f"Loss weights must be finite, not negative and not all 0; got {self.weights}.")
        for name, term in terms.items():
            if term.stream not in STREAMS:
                known = ", ".join(sorted(STREAMS))
                raise ValueError(f"The loss term {name} reads the stream {term.stream!r}; streams are {known}.")
        if not (isinstance(hardest, (int, float)) and 0 < hardest <= 1):
            raise ValueError(f"loss.hardest is a share in (0, 1]; got {hardest!r}.")
        self.terms = nn.ModuleDict(terms)
        self.norm, self.scaled, self.balance, self.hardest = Norm(norm), scaled, balance, hardest
        self.register_buffer("running", torch.zeros(len(terms)))

    def used(self, *, exact_terminal: bool) -> dict[str, LossTerm]:
        """Terms that count, by name: those of positive weight that do not hold by construction.

        Raises:
            ValueError: none is left.
        """
        found = {
            name: term
            for name, term in self.terms.items()
            if isinstance(term, LossTerm)
            and self.weights[name] > 0
            and not (exact_terminal and term.met_by_exact_terminal)
        }
        if not found:
            raise ValueError(
                f"No loss term is left to train with: {', '.join(self.terms)} hold by construction or weigh nothing. "
                "With an exact terminal condition the boundary does not count."
            )
        return found

    def streams(self, *, exact_terminal: bool) -> frozenset[str]:
        """Data streams that the terms that count read. Raises as `used`."""
        return frozenset(term.stream for term in self.used(exact_terminal=exact_terminal).values())

    def kept(self, rows: int) -> int:
        """How many of so many collocation points count."""
        return rows if self.hardest == 1 else max(1, round(self.hardest * rows))

    def residual(self, name: str, view: View) -> Tensor:
        """Residual of a term, in the size that it states if `scaled`."""
        term = self.terms[name]
        assert isinstance(term, LossTerm)
        residual = term.residual(view)
        return residual / term.scale(view) if self.scaled else residual

    def reduced(self, name: str, view: View) -> Tensor:
        """Norm of a term's residual, scalar."""
        return self.norm(self.residual(name, view))

    def total(self, reduced: Mapping[str, Tensor], *, train: bool = False) -> Tensor:
        """The weighted sum of reduced terms, scalar.

        Args:
            reduced: by name.
            train: whether it is a training step: terms are then divided by their running means, if they are balanced.
        """
        parts = {name: self._balanced(name, loss) if train else loss for name, loss in reduced.items()}
        return torch.stack([self.weights[name] * loss for name, loss in parts.items()]).sum()

    def _balanced(self, name: str, loss: Tensor) -> Tensor:
        if not self.balance:
            return loss
        place = list(self.terms).index(name)
        before, now = self.running[place], loss.detach()
        self.running[place] = torch.where(before > 0, torch.lerp(now, before, 0.99), now)
        return loss / self.running[place].clamp_min(torch.finfo(loss.dtype).tiny)


def make_objective(terms: Mapping[str, Mapping[str, Any]], weights: Mapping[str, float], **options: Any) -> Objective:
    """An objective of registered terms.

    Args:
        terms: options of each term, by its registered name.
        weights: see `Objective`.
        options: further arguments of `Objective`.

    Raises:
        UnknownNameError: a term that is not registered, or an option that it does not know.
        ValueError: see `Objective`.
    """
    built = {}
    for name, given in terms.items():
        cls = losses.get(name)
        check_options(f"loss {name}", cls, given)
        built[name] = cls(**given)
    return Objective(built, weights, **options)
