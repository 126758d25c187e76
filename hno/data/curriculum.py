"""Which times are sampled at which step."""

from __future__ import annotations

from typing import NamedTuple


class Curriculum(NamedTuple):
    """A time window that widens linearly from the terminal time (paper, sec. IV)."""

    start: int
    """Step at which collocation begins; before it the training is supervised only."""
    length: int
    """Steps until the window is the whole horizon; 0 opens it at once."""
    end: int | None = None
    """Step at which collocation ends, after which the training is supervised only again; None for never. There is none
    at all where it ends before it begins."""

    def active(self, step: int) -> bool:
        """Whether collocation points are drawn at this step."""
        return self.start <= step and (self.end is None or step < self.end)

    def window(self, step: int) -> float:
        """Share of the horizon that tau may reach, in [0, 1]."""
        if not self.active(step):
            return 0.0
        return min(1.0, (step - self.start + 1) / self.length) if self.length > 0 else 1.0
