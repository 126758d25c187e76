"""What the batches of a run are made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from hno.data.curriculum import Curriculum
from hno.data.sources import Sampler, make_sampler
from hno.pontryagin.solve import Solver

MIXED: Mapping[str, float] = {"box": 0.3, "band": 0.2, "labels": 0.5}
"""Shares of the default sampler."""
BATCH_SIZES: Mapping[str, int | None] = {"bvp": 2048, "interior": 512, "terminal": 128}
"""Rows per step of each stream by default."""


@dataclass(frozen=True)
class LabelPlan:
    """Which labels are solved, read or brought along."""

    types: Sequence[Sequence[float]] = ()
    """Player types with labels; the corners of the type box and points between them by default."""
    trajectories: int = 160
    """Labelled trajectories per type."""
    validation: int = 16
    """Trajectories per type that are held out."""
    widen: Sequence[float] = (1.0,)
    """Widths of the boxes that starts are drawn from, in units of the game's start box, in equal shares."""
    files: Sequence[Path] = ()
    """Label files of your own, see `hno.data.exchange`; their types count as labelled."""
    cache: Path | None = None
    """Folder of label files; $HNO_CACHE or the user's cache folder by default."""
    solver: Solver = Solver()
    workers: int | None = None
    """Label processes; as many as the job has cores by default."""

    def shares(self, number: int) -> list[int]:
        """So many trajectories in equal shares, one for each width; what cannot be shared goes to the first ones."""
        return [number // len(self.widen) + (place < number % len(self.widen)) for place in range(len(self.widen))]


@dataclass(frozen=True)
class Collocation:
    """Which collocation points are drawn, and when."""

    sampler: Sampler = field(default_factory=lambda: make_sampler(MIXED))
    """Where they come from."""
    curriculum: Curriculum = field(default_factory=lambda: Curriculum(0, 0))
    """When collocation begins, how the window widens, and when it ends."""
    types: str = "labelled"
    """"labelled" draws their player types among those of the labels, "box" from the type box."""
