"""The only LightningModule: an operator, an objective and an optimiser."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import lightning as L
import torch
from torch import Tensor, nn
from torchmetrics import WeightedMeanAbsolutePercentageError

from hno.losses import Objective, View
from hno.operators.base import FieldFunction, ValueOperator
from hno.operators.inputs import distinct_types
from hno.training.ranks import Ranks
from hno.types import Batch, Field, Points, PotentialField, Sample, tables

Optimizer = Callable[[Iterable[nn.Parameter]], Mapping[str, Any]]
"""Builds what Lightning's `configure_optimizers` returns."""


class TrainingModule(L.LightningModule):
    """Trains an operator.

    Args:
        operator: what is trained.
        objective: loss terms and weights.
        optimizer: needed for training only.
        record: entries that are added to checkpoints.
        ranks: the place of this process among those that train together.
    """

    def __init__(
        self,
        operator: ValueOperator,
        objective: Objective,
        optimizer: Optimizer | None = None,
        record: Mapping[str, Any] | None = None,
        ranks: Ranks = Ranks(),
    ) -> None:
        super().__init__()
        self.operator, self.objective, self.optimizer, self.record = operator, objective, optimizer, record or {}
        self.ranks = ranks
        self.began = self.stepped = False
        self.terms = objective.used(exact_terminal=operator.meets_terminal)
        self.streams = objective.streams(exact_terminal=operator.meets_terminal)
        self.value_error = WeightedMeanAbsolutePercentageError()
        self.costate_error = WeightedMeanAbsolutePercentageError()

    def on_train_start(self) -> None:
        """A checkpoint to go on from has been restored, but whether the optimiser can use its state shows in a step."""
        self.began = True

    def on_before_optimizer_step(self, optimizer: Any) -> None:
        """Losses and gradients are there."""
        self.began = self.stepped

    def on_train_batch_end(self, outputs: Any, batch: Batch, batch_idx: int) -> None:
        """All that was restored is of use."""
        self.began = self.stepped = True

    def backward(self, loss: Tensor, *arguments: Any, **options: Any) -> None:
        """Gradients of the whole batch, of which this rank has its share."""
        super().backward(loss, *arguments, **options)
        self.ranks.add_gradients(self.operator.parameters())

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Weighted sum of the terms whose stream is in the batch; the others are logged as NaN."""
        losses = self.losses(batch)
        total = self.objective.total(losses, train=True)
        absent = dict.fromkeys(self.terms, torch.tensor(torch.nan))
        self.log_dict({f"loss/{name}": loss.detach() for name, loss in (absent | losses).items()})
        self.log("loss/total", total.detach(), prog_bar=True)
        return total

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Reduced terms whose stream is in the batch, mean over the operator's members, scalars by name.

        Every rank is given the whole batch and takes its share; the numbers are those of the whole.
        """
        chosen = {name: self._hardest(name, sample) for name, sample in batch.items() if name in self.streams}
        kept = {name: self.ranks.share(sample) for name, sample in chosen.items()}
        read = {name: term.stream for name, term in self.terms.items() if term.stream in kept}
        points = Points(*(torch.cat(parts) for parts in zip(*(s.points for s in kept.values()), strict=True)))
        types = tables([sample.types or distinct_types(sample.points.theta) for sample in kept.values()])
        sizes = [sample.size for sample in kept.values()]
        reduced, entries = list[Tensor](), list[Tensor]()
        for member in self.operator.members:
            field = member(points, types)
            columns = zip(*(part.split(sizes) for part in field), strict=True)
            fields = dict(zip(kept, (type(field)(*parts) for parts in columns), strict=True))
            views = {stream: self._view(kept[stream], fields[stream], member) for stream in kept}
            residuals = [self.objective.residual(name, views[stream]) for name, stream in read.items()]
            reduced.append(torch.stack([self.objective.norm(residual) for residual in residuals]))
            entries.append(reduced[-1].new_tensor([residual.numel() for residual in residuals]))
        means = self.ranks.mean(torch.stack(reduced).flatten(), torch.stack(entries).flatten())
        return dict(zip(read, means.unflatten(0, (-1, len(read))).mean(0).unbind(), strict=True))

    def _view(self, sample: Sample, field: Field | PotentialField, member: FieldFunction) -> View:
        return self.operator.view(sample, field, lambda at: member(at, None), self.global_step)

    def _hardest(self, stream: str, sample: Sample) -> Sample:
        """The collocation points of the largest residuals, if only those count."""
        if stream != "interior" or self.objective.hardest == 1:
            return sample
        with torch.no_grad():
            field = self.operator.field(sample.points, sample.types)
            view = self._view(sample, field, self.operator.field)
            names = [name for name, term in self.terms.items() if term.stream == stream]
            found = [self.objective.residual(name, view).abs().flatten(1).amax(-1) for name in names]
        worst = torch.stack(found).amax(0)
        return sample.rows(worst.topk(self.objective.kept(len(worst))).indices)

    def on_validation_start(self) -> None:
        """What rank 0 validates and saves is what all have."""
        self.ranks.check_alike(self.operator.parameters())

    def validation_step(self, sample: Sample | None, batch_idx: int) -> None:
        """Weighted absolute percentage errors of values and costates on held-out labels, if there are any."""
        if sample is None:
            return
        if sample.labels is None:
            raise ValueError("Validation needs labelled rows; this sample has points only.")
        field = self.operator.field(sample.points, sample.types)
        self.value_error(field.value, sample.labels.value)
        self.costate_error(field.costate.flatten(1), sample.labels.costate.flatten(1))
        self.log_dict({"val/value_error": self.value_error, "val/costate_error": self.costate_error})

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the record."""
        checkpoint.update(self.record)

    def configure_optimizers(self) -> Any:
        """What the `optimizer` argument builds."""
        if self.optimizer is None:
            raise ValueError("This module was built without an optimizer; pass one to train it.")
        return self.optimizer(self.operator.parameters())
