"""The streams of training batches, each a pure function of (seed, step)."""

from __future__ import annotations

import copy
import hashlib
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import lightning as L
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, IterableDataset

from hno.data.curriculum import Curriculum
from hno.data.exchange import read_own
from hno.data.labels import Report, Request, labels_for
from hno.data.rows import rows_of
from hno.data.sampling import check_shares, sample_states
from hno.games import Game
from hno.pontryagin.solve import Solver
from hno.types import Batch, Extremal, Sample, Trajectory, Types, part

BOX_TYPES = 32
"""Types that one batch of collocation points draws from the type box: the branch runs once for each."""


class Visit(NamedTuple):
    """Where the closed-loop episodes of a validation went."""

    step: int
    """The training step after which they were played."""
    tau: Tensor
    """Times to go, (L,)."""
    x: Tensor
    """States, (L, P, n)."""


class GameData(L.LightningDataModule):
    """Labelled rows and collocation points of one game.

    Only the streams in `streams` are built. Labels are solved where the cache lacks them.

    Args:
        game: the game.
        streams: stream names, of `hno.losses.STREAMS`.
        types: player types with labels.
        trajectories: labelled trajectories per type.
        cache: folder of label files.
        seed: of start states, batches and collocation points.
        batch_sizes: rows per step of each stream; None for every labelled row, each step.
        curriculum: when collocation begins, how the window widens, and when it ends.
        shares: where interior points come from, see `hno.data.sampling.SOURCES`.
        interior_types: "labelled" draws the types of collocation points among `types`, "box" from the type box.
        validation: trajectories per type that are held out.
        solver: settings of the label solver.
        workers: label processes; the number of cores by default.
        files: label files of your own, see `hno.data.exchange`; their types count as labelled.
        report: called as labels are written.
    """

    def __init__(
        self,
        game: Game,
        streams: Collection[str],
        types: Sequence[Sequence[float]],
        trajectories: int,
        cache: Path,
        seed: int,
        batch_sizes: Mapping[str, int | None],
        curriculum: Curriculum,
        shares: Mapping[str, float],
        interior_types: str = "labelled",
        validation: int = 8,
        solver: Solver = Solver(),
        workers: int | None = None,
        files: Sequence[Path] = (),
        report: Report | None = None,
    ) -> None:
        super().__init__()
        check_shares(shares)
        if interior_types not in ("labelled", "box"):
            raise ValueError(f"interior_types must be 'labelled' or 'box'; got {interior_types!r}.")
        if "bvp" not in streams and (curriculum.start > 0 or curriculum.end is not None):
            raise ValueError(
                "Nothing is trained before collocation begins and after it ends: weigh a supervised term, or set "
                "pretrain and finish to 0."
            )
        for name, size in {"trajectories": trajectories, "validation": validation, **batch_sizes}.items():
            if size is not None and size < 1:
                raise ValueError(f"The number of rows or trajectories {name!r} must be at least 1; got {size}.")
        self.game = copy.deepcopy(game)  # the operator moves its own to a device; batches are made on the CPU
        self.streams, self.seed = frozenset(streams), seed
        self.own = [read_own(path, game) for path in files]
        for path, labels in zip(files, self.own, strict=True):
            if len(labels.status) <= validation:
                raise ValueError(
                    f"{path} holds {len(labels.status)} labels and {validation} are held out: none is left to train "
                    "on. Bring more, or lower data.validation."
                )
        solved = [tuple(map(float, theta)) for theta in types]
        brought = [tuple(theta) for labels in self.own for theta in labels.theta.unique(dim=0).tolist()]
        self.type_list = list(dict.fromkeys([*solved, *brought]))
        if not self.type_list:
            raise ValueError(
                "There are no labelled types: name some in data.types, or files of your own in data.files."
            )
        self.types = torch.tensor(self.type_list)
        self.batch_sizes, self.curriculum, self.shares = dict(batch_sizes), curriculum, dict(shares)
        self.interior_types, self.cache, self.solver, self.workers = interior_types, cache, solver, workers
        self.report = report
        self.requests = [Request(theta, trajectories + validation, seed, "train") for theta in solved]
        self.validation = validation
        self.label_seconds = 0.0
        self.extremals: list[Extremal] = []
        self.visits: list[Visit] = []
        """The latest two validations."""

    def prepare_data(self) -> None:
        """Solve what the cache lacks."""
        if self.extremals:
            return
        arguments = self.game, self.requests, self.cache, self.solver, self.workers, self.report
        found, self.label_seconds = labels_for(*arguments)
        self.extremals = [*found, *self.own]

    def setup(self, stage: str) -> None:
        """Load labels into memory."""
        if not self.extremals:
            self.prepare_data()
        held_out = -self.validation
        self.train_rows = rows_of(self.game, [part(found, slice(held_out)) for found in self.extremals])
        self.val_rows = rows_of(self.game, self.held_out())

    def held_out(self) -> list[Extremal]:
        """Labels that are not trained on, one set per labelled type."""
        return [part(found, slice(-self.validation, None)) for found in self.extremals]

    def label_scales(self) -> tuple[Tensor, Tensor]:
        """Mean absolute value, scalar, and mean absolute costate, (P, P, n), of the training labels.

        A state that hardly matters keeps a thousandth of value / box width, so that dividing by its size is safe.
        """
        labels = self.train_rows.labels
        assert labels is not None
        value = labels.value.abs().mean()
        value = torch.where(value > 0, value, torch.ones_like(value))
        return value, labels.costate.abs().mean(0).maximum(1e-3 * value / self.game.state_box.width)

    def visit(self, played: Trajectory, step: int = -1) -> None:
        """Take note of where the episodes of a validation after some step went, as far as they stayed finite."""
        tau = (self.game.horizon - played.t).expand(len(played.x), -1).flatten()
        x = played.x.flatten(0, 1)
        finite = x.flatten(1).isfinite().all(-1)
        if bool(finite.any()):
            self.visits = [*self.visits[-1:], Visit(step, tau[finite].cpu(), x[finite].cpu())]

    def state_dict(self) -> dict[str, Any]:
        """What batches depend on besides the step."""
        return {"visits": [visit._asdict() for visit in self.visits]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from it."""
        self.visits = [Visit(**visit) for visit in state_dict["visits"]]

    def batch(self, step: int) -> Batch:
        """The batch of one step, a pure function of (seed, step, rank), and of earlier `visits`."""
        rank = self.trainer.global_rank if self.trainer is not None else 0
        generator = torch.Generator().manual_seed(_mix(step, self.seed, rank))
        batch: Batch = {}
        if "bvp" in self.streams:
            batch["bvp"] = self.train_rows.rows(self._row_numbers(generator))
        if self.curriculum.active(step):
            for name in sorted(self.streams & {"interior", "terminal"}):
                batch[name] = self._collocation(name, step, generator)
        return batch

    def large_batch(self, step: int) -> Batch:
        """All labelled rows, and collocation points in proportion to the usual batch."""
        usual = self.batch_sizes
        factor = math.ceil(self.train_rows.size / (usual["bvp"] or self.train_rows.size))
        self.batch_sizes = {name: None if name == "bvp" or not size else factor * size for name, size in usual.items()}
        try:
            return self.batch(step)
        finally:
            self.batch_sizes = usual

    def _row_numbers(self, generator: torch.Generator) -> Tensor:
        size = self.batch_sizes["bvp"]
        if size is None:
            return torch.arange(self.train_rows.size)
        return torch.randint(self.train_rows.size, (size,), generator=generator)

    def _visited(self, step: int) -> tuple[Tensor, Tensor] | None:
        """Where the latest validation before a step went. Batches are drawn a step ahead: later ones do not count."""
        earlier = [visit for visit in self.visits if visit.step < step]
        return (earlier[-1].tau, earlier[-1].x) if earlier else None

    def _collocation(self, stream: str, step: int, generator: torch.Generator) -> Sample:
        size = self.batch_sizes[stream] or self.train_rows.size
        table = self.types
        if self.interior_types == "box":
            table = self.game.type_box.sample(BOX_TYPES, generator)
        which = torch.randint(len(table), (size,), generator=generator)
        labelled = self.train_rows.points.tau, self.train_rows.points.x
        pools = {"labels": labelled, "rollout": self._visited(step) or labelled}
        points = sample_states(self.game, table[which], self.shares, pools, self.curriculum.window(step), generator)
        points = points._replace(tau=torch.zeros_like(points.tau)) if stream == "terminal" else points
        return Sample(points, types=Types(table, which))

    def train_dataloader(self) -> DataLoader[Batch]:
        """Batches from the trainer's current step on, without end."""
        first = self.trainer.global_step if self.trainer is not None else 0
        return DataLoader(_Steps(self, first), batch_size=None)

    def val_dataloader(self) -> DataLoader[Sample]:
        """Held-out labelled rows, in one batch."""
        return DataLoader(_Whole(self.val_rows), batch_size=None)


class _Whole(Dataset[Sample]):
    def __init__(self, sample: Sample) -> None:
        self.sample = sample

    def __len__(self) -> int:
        return 1

    def __getitem__(self, index: int) -> Sample:
        return self.sample


class _Steps(IterableDataset[Batch]):
    def __init__(self, data: GameData, first: int) -> None:
        self.data, self.first = data, first

    def __iter__(self) -> Iterator[Batch]:
        step = self.first
        while True:
            yield self.data.batch(step)
            step += 1


def _mix(step: int, *run: int) -> int:
    """A generator seed for a step of a run; no two steps of a run share one.

    It has 32 bits because PyTorch's CPU generator reads no more: whatever stands higher would be ignored.
    """
    first = int.from_bytes(hashlib.sha256(repr(run).encode()).digest()[:4])
    return (first + 0x9E3779B9 * step) % 2**32
