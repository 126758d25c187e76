"""The streams of training batches, each a pure function of (seed, step)."""

from __future__ import annotations

import copy
import hashlib
import math
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any, NamedTuple

import lightning as L
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from hno.data.exchange import read_own
from hno.data.labelled import LabelledRows
from hno.data.labels import Report, Request, default_cache, labels_for
from hno.data.plans import BATCH_SIZES, Collocation, LabelPlan
from hno.data.sources import Known, Pool, sample_points
from hno.games import Game
from hno.processes import stop_if_asked
from hno.types import (
    Batch,
    Extremal,
    Sample,
    Trajectory,
    Types,
    best_of,
    of_starts,
)

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

    Only the streams in `streams` are built. Labels are solved where the cache lacks them, and only if the stream of
    labelled rows or a source of collocation points reads them.

    Args:
        game: the game.
        streams: stream names, of `hno.losses.STREAMS`.
        seed: of start states, batches and collocation points.
        labels: which labels there are.
        collocation: which collocation points.
        batch_sizes: rows per step of each stream; None for every labelled row, each step.
        report: called as labels are written.
        potential: label with the potential of every equilibrium rather than with the players' values at the best one.

    Raises:
        ValueError: sizes, types or shares that make no sense, or nothing to train on at some step.
    """

    def __init__(
        self,
        game: Game,
        streams: Collection[str],
        seed: int = 0,
        labels: LabelPlan = LabelPlan(),
        collocation: Collocation | None = None,
        batch_sizes: Mapping[str, int | None] = BATCH_SIZES,
        report: Report | None = None,
        potential: bool = False,
    ) -> None:
        super().__init__()
        self.potential = potential
        self.game = copy.deepcopy(game)  # the operator moves its own to a device; batches are made on the CPU
        self.streams, self.seed, self.labels, self.report = frozenset(streams), seed, labels, report
        self.collocation, self.batch_sizes = collocation or Collocation(), dict(batch_sizes)
        self._check()
        self.own = [read_own(path, game) for path in labels.files]
        self._check_own()
        solved = self.game.validate_types(labels.types or ([] if labels.files else self.game.default_types()))
        brought = [tuple(theta) for own in self.own for theta in own.theta.unique(dim=0).tolist()]
        self.type_list = list(dict.fromkeys([*solved, *brought]))
        self.types = torch.tensor(self.type_list)
        parts = labels.widen, labels.shares(labels.trajectories), labels.shares(labels.validation)
        shares = [(widen, trained, kept) for widen, trained, kept in zip(*parts, strict=True) if trained + kept]
        self.requests = [
            Request(theta, trained + kept, seed, "train", widen, all_equilibria=potential)
            for theta in solved
            for widen, trained, kept in shares
        ]
        self.kept = [kept for _ in solved for *_, kept in shares] + [labels.validation] * len(self.own)
        """Start states of each label set that are held out."""
        self.label_seconds = 0.0
        self.extremals: list[Extremal] = []
        self.labelled: LabelledRows | None = None
        self.val_rows: Sample | None = None
        self.visits: list[Visit] = []
        """The latest two validations."""
        self.between: Callable[[], None] = stop_if_asked
        """Called between two steps, where nothing is half done."""

    def _check(self) -> None:
        if self.collocation.types not in ("labelled", "box"):
            raise ValueError(f"data.interior_types must be 'labelled' or 'box'; got {self.collocation.types!r}.")
        curriculum = self.collocation.curriculum
        if "bvp" not in self.streams and (curriculum.start > 0 or curriculum.end is not None):
            raise ValueError(
                "Nothing is trained before collocation begins and after it ends: weigh a supervised term, or set "
                "data.pretrain and data.finish to 0."
            )
        if not self.labels.widen or not all(width > 0 for width in self.labels.widen):
            raise ValueError(f"data.widen must be one or several positive widths; got {self.labels.widen}.")
        sizes = {"trajectories": self.labels.trajectories, "validation": self.labels.validation, **self.batch_sizes}
        for name, size in sizes.items():
            if size is not None and size < 1:
                raise ValueError(f"The number of rows or trajectories {name!r} must be at least 1; got {size}.")
            if size is None and name in self.streams and not self.needs_labels:
                raise ValueError(f"Without labels, data.batch_sizes.{name} must be a number of rows; got {size}.")

    def _check_own(self) -> None:
        held_out = self.labels.validation
        for path, found in zip(self.labels.files, self.own, strict=True):
            if found.starts <= held_out:
                raise ValueError(
                    f"{path} holds {found.starts} labels and {held_out} are held out: none is left to train on. "
                    "Bring more, or lower data.validation."
                )

    @property
    def needs_labels(self) -> bool:
        """Whether a stream or a source of collocation points reads labels."""
        sampled = self.streams & {"interior", "terminal"}
        return "bvp" in self.streams or (
            bool(sampled) and any(share.source.needs_labels for share in self.collocation.sampler.values())
        )

    def prepare_data(self) -> None:
        """Solve what the cache lacks, if labels are needed."""
        if self.extremals or self.labelled is not None or not self.needs_labels:
            return
        plan = self.labels
        arguments = self.game, self.requests, plan.cache or default_cache(), plan.solver, plan.workers, self.report
        found, self.label_seconds = labels_for(*arguments)
        self.extremals = [*found, *self.own]

    def setup(self, stage: str) -> None:
        """Load labels into memory, once."""
        self.prepare_data()
        if not self.extremals or self.labelled is not None:
            return
        trained = [of_starts(found, 0, found.starts - kept) for found, kept in self._split()]
        held_out = [of_starts(found, found.starts - kept) for found, kept in self._split()]
        self.labelled = LabelledRows(self.game, trained, self.potential)
        self.val_rows = self.labelled.of(held_out)

    def for_another_process(self) -> GameData:
        """A copy that draws the same batches, without the labels that its rows were made of, and without a trainer."""
        other = copy.copy(self)
        other.trainer, other.report, other.between = None, None, stop_if_asked
        other.extremals, other.own = [], []
        return other

    @property
    def train_rows(self) -> Sample | None:
        """Labelled rows before any were added."""
        return None if self.labelled is None else self.labelled.first

    def _split(self) -> Iterator[tuple[Extremal, int]]:
        """Labels of every set, and how many of its start states are held out; none without labels."""
        return zip(self.extremals, self.kept, strict=bool(self.extremals))

    def held_out(self) -> list[Extremal]:
        """The best labels of start states that are not trained on, one set per request; none without labels."""
        return [best_of(of_starts(found, found.starts - kept)) for found, kept in self._split()]

    def scales(self) -> tuple[Tensor, Tensor]:
        """Typical sizes of values, scalar, and of costates, (P, P, n) or (1, P, n).

        The mean absolute values and costates of the training labels; without labels, the mean terminal value over the
        PDE box, and that per width of the box. A state that hardly matters keeps a thousandth of value / box width, so
        that dividing by its size is safe.
        """
        width = self.game.state_box.width
        if self.train_rows is None:
            x = self.game.state_box.sample(4096, torch.Generator().manual_seed(self.seed))
            value = self.game.terminal_value(x).abs().mean().clamp_min(1e-3)
            functions = 1 if self.potential else self.game.players
            return value, (value / width).expand(functions, -1, -1).clone()
        labels = self.train_rows.labels
        assert labels is not None
        value = labels.value.abs().mean()
        value = torch.where(value > 0, value, torch.ones_like(value))
        return value, labels.costate.abs().mean(0).maximum(1e-3 * value / width)

    def visit(self, played: Trajectory, step: int = -1) -> None:
        """Take note of where the episodes of a validation after some step went, as far as they stayed finite."""
        tau = (self.game.horizon - played.t).expand(len(played.x), -1).flatten()
        x = played.x.flatten(0, 1)
        finite = x.flatten(1).isfinite().all(-1)
        if bool(finite.any()):
            self.visits = [*self.visits[-1:], Visit(step, tau[finite].cpu(), x[finite].cpu())]

    def state_dict(self) -> dict[str, Any]:
        """What batches depend on besides the step."""
        added = [] if self.labelled is None else self.labelled.state()
        return {"visits": [visit._asdict() for visit in self.visits], "added": added}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore it."""
        self.visits = [Visit(**visit) for visit in state_dict["visits"]]
        if self.labelled is not None:
            self.labelled.restore(state_dict["added"])

    def batch(self, step: int, sizes: Mapping[str, int | None] | None = None) -> Batch:
        """The batch of one step, a pure function of (seed, step), and of earlier `visits`.

        Args:
            step: the training step.
            sizes: rows of each stream, `batch_sizes` by default.
        """
        sizes = sizes or self.batch_sizes
        generator = torch.Generator().manual_seed(mix(step, self.seed, 0))
        batch: Batch = {}
        if "bvp" in self.streams and self.labelled is not None:
            (rows, drawn), size = self.labelled.at(step), sizes["bvp"]
            chosen = drawn if size is None else drawn[torch.randint(len(drawn), (size,), generator=generator)]
            batch["bvp"] = rows.rows(chosen)
        if self.collocation.curriculum.active(step):
            for name in sorted(self.streams & {"interior", "terminal"}):
                batch[name] = self._collocation(name, step, sizes[name], generator)
        return batch

    def large_batch(self, step: int) -> Batch:
        """All labelled rows, and collocation points in proportion to the usual batch."""
        usual, rows = self.batch_sizes, 1 if self.train_rows is None else self.train_rows.size
        factor = math.ceil(rows / (usual["bvp"] or rows))
        return self.batch(
            step, {name: None if name == "bvp" or not size else factor * size for name, size in usual.items()}
        )

    def _known(self, step: int) -> Known:
        """What sources draw on at a step. Batches are drawn a step ahead: later validations do not count."""
        rows, earlier = self.train_rows, [visit for visit in self.visits if visit.step < step]
        labels = None if rows is None else Pool(rows.points.tau, rows.points.x)
        return Known(labels, Pool(earlier[-1].tau, earlier[-1].x) if earlier else None)

    def _collocation(self, stream: str, step: int, size: int | None, generator: torch.Generator) -> Sample:
        if size is None:
            assert self.train_rows is not None
            size = self.train_rows.size
        plan, table = self.collocation, self.types
        if plan.types == "box":
            table = self.game.type_box.sample(BOX_TYPES, generator)
        which = torch.randint(len(table), (size,), generator=generator)
        window = plan.curriculum.window(step)
        points = sample_points(self.game, table[which], plan.sampler, self._known(step), window, generator)
        points = points._replace(tau=torch.zeros_like(points.tau)) if stream == "terminal" else points
        return Sample(points, types=Types(table, which))

    def train_dataloader(self) -> DataLoader[Batch]:
        """Batches from the trainer's current step on, without end."""
        first = self.trainer.global_step if self.trainer is not None else 0
        return DataLoader(_Steps(self, first), batch_size=None)

    def val_dataloader(self) -> DataLoader[Sample | None]:
        """Held-out labelled rows, in one batch; None without labels."""
        return DataLoader([self.val_rows], batch_size=None)  # type: ignore[arg-type]  # a list is a data set


class _Steps(IterableDataset[Batch]):
    def __init__(self, data: GameData, first: int) -> None:
        self.data, self.first = data, first

    def __iter__(self) -> Iterator[Batch]:
        step = self.first
        while True:
            self.data.between()
            yield self.data.batch(step)
            step += 1


def mix(step: int, *run: int) -> int:
    """A generator seed for a step of a run; no two steps of a run share one.

    It has 32 bits because PyTorch's CPU generator reads no more: whatever stands higher would be ignored.
    """
    first = int.from_bytes(hashlib.sha256(repr(run).encode()).digest()[:4])
    return (first + 0x9E3779B9 * step) % 2**32
