"""The labelled rows that batches are drawn from, which may grow while an operator trains."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from hno.data.branches import principal_axes
from hno.data.rows import converged, potential_rows, rows_of
from hno.games import Game
from hno.types import Extremal, Labels, Points, PotentialLabels, Sample, Types, joined


class LabelledRows:
    """Rows of training labels.

    Args:
        game: the game.
        trained: labels that are trained on.
        potential: make rows of the potential of every equilibrium rather than of the players' values at the best one.

    Raises:
        NoLabelsError: none converged.
    """

    def __init__(self, game: Game, trained: Sequence[Extremal], potential: bool) -> None:
        self.game = game
        self.axes = principal_axes(game, converged(game, trained)) if potential else None
        """Of the potential's branches, see `hno.data.branches`, (pairs, 3)."""
        self.first = self.of(trained, swapped=True)
        """The rows before any were added."""
        self.added: list[tuple[int, Sample]] = []
        """Rows that were added after a training step."""
        self._joined: tuple[int, Sample, Tensor] | None = None

    def of(self, labels: Sequence[Extremal], *, swapped: bool = False) -> Sample:
        """Rows of labels; `swapped` as in `potential_rows`. Raises NoLabelsError where none converged."""
        if self.axes is None:
            return rows_of(self.game, labels)
        return potential_rows(self.game, labels, self.axes, swapped=swapped)

    def extend(self, step: int, labels: Sequence[Extremal]) -> None:
        """Train on more labels, of the game or what remains of it, from the batch after the next one of a step on."""
        if any(len(found.status) for found in labels):
            self.added.append((step, self.of(labels, swapped=True)))

    def at(self, step: int) -> tuple[Sample, Tensor]:
        """All rows of a step, and the ones of them that a batch is drawn from: best equilibria count twice.

        Batches are drawn a step ahead: what was added just before does not count.
        """
        known = [rows for after, rows in self.added if after < step]
        if self._joined is None or self._joined[0] != len(known):
            whole = joined([self.first, *known])
            drawn, labels = torch.arange(whole.size), whole.labels
            if isinstance(labels, PotentialLabels):
                drawn = torch.cat([drawn, labels.best.nonzero().squeeze(-1)])
            self._joined = len(known), whole, drawn
        return self._joined[1:]

    def state(self) -> list[list[Any]]:
        """What was added, in plain containers."""
        return [[step, *map(list, filter(None, rows))] for step, rows in self.added]

    def restore(self, state: Sequence[Sequence[Any]]) -> None:
        """Have what was added when the state was taken."""
        kind = Labels if self.axes is None else PotentialLabels
        self.added = [
            (step, Sample(Points(*points), kind(*labels), Types(*types))) for step, points, labels, types in state
        ]
