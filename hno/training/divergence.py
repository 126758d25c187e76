"""Ends a training that diverges."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import lightning as L
import safetensors.torch
import torch
from torch import Tensor, nn

from hno.data.store import replace_whole
from hno.training.saving import CheckpointFiles, not_finite
from hno.types import Batch

ERROR = "val/costate_error"
BAD_BATCH = "bad_batch.safetensors"
"""Name, inside a run's folder, of the batch that made a training diverge."""


class DivergedError(RuntimeError):
    """The loss, a gradient, a weight or the error on held-out labels is no longer sound; `what` says which."""

    def __init__(self, what: str, *further: str) -> None:
        advice = f"{what}: the training diverged. Lower optimizer.lr or set trainer.gradient_clip_val."
        super().__init__(" ".join([advice, *further]))


class StopOnDivergence(L.Callback):
    """Raise where a number of the training is not finite, or where the error on held-out labels has exploded.

    The loss and the gradients are tested at every step before the weights are changed, the weights and the state of
    the optimiser before they are saved and at the end, the error at each validation. The batch of the step goes into
    the folder.

    Args:
        folder: of the run.
        files: where checkpoints go, which knows the last good one.
        growth: how many times its smallest value so far the error may become.
    """

    def __init__(self, folder: Path, files: CheckpointFiles, growth: float = 10.0) -> None:
        self.folder, self.files, self.growth = folder, files, growth
        self.smallest = math.inf
        self.loss = torch.tensor(0.0)
        self.batches = list[Batch]()

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Batch, batch_idx: int
    ) -> None:
        """Keep the batch and the one before it: whose step spoils the weights is seen at the next one."""
        self.batches = [*self.batches[-1:], batch]

    def on_before_backward(self, trainer: L.Trainer, pl_module: L.LightningModule, loss: Tensor) -> None:
        """Keep the loss."""
        self.loss = loss.detach()

    def on_before_optimizer_step(
        self, trainer: L.Trainer, pl_module: L.LightningModule, optimizer: torch.optim.Optimizer
    ) -> None:
        """Test the loss and the gradients, for which this waits for the device; a scaler skips bad gradients itself."""
        scaled = getattr(trainer.precision_plugin, "scaler", None) is not None
        found = [] if scaled else [p.grad for group in optimizer.param_groups for p in group["params"]]
        largest = [torch.linalg.vector_norm(grad, torch.inf) for grad in found if grad is not None]
        if bool(torch.stack([self.loss.abs(), *largest]).isfinite().all()):
            return
        step = trainer.global_step + 1
        if not finite_weights(pl_module):
            self.batches.pop()
            raise self.diverged(trainer, f"Step {step - 1} left weights that are not finite")
        loss = float(self.loss)
        what = "A gradient is not finite" if math.isfinite(loss) else f"The loss is {loss}"
        raise self.diverged(trainer, f"{what} at step {step}")

    def on_save_checkpoint(self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]) -> None:
        """Refuse to save what is not finite."""
        if (name := not_finite(checkpoint)) is not None:
            raise self.diverged(trainer, f"Step {trainer.global_step} left {name} with entries that are not finite")

    def diverged(self, trainer: L.Trainer, what: str) -> DivergedError:
        """The error, once the latest batch is in the folder."""
        further = []
        if self.batches and trainer.global_rank == 0:  # which all ranks know whole
            path = self.folder / BAD_BATCH
            try:
                write_batch(path, self.batches[-1])
                further.append(f"The batch of that step is in {path}.")
            except OSError as error:
                further.append(f"The batch of that step cannot be written ({error}).")
        if self.files.latest is not None:
            further.append(f"The last good checkpoint is {self.files.latest}.")
        return DivergedError(what, *further)

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Test the error of costates on held-out labels."""
        error = float(trainer.callback_metrics.get(ERROR, 0.0))
        self.smallest = min(self.smallest, error)
        if not (math.isfinite(error) and error <= self.growth * self.smallest):
            was = f"; it was {self.smallest:.3g}" if self.smallest < math.inf else ""
            raise self.diverged(trainer, f"The error of costates is {error:.3g} at step {trainer.global_step}{was}")

    def state_dict(self) -> dict[str, Any]:
        """The smallest error so far."""
        return {"smallest": self.smallest}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore it."""
        self.smallest = state_dict["smallest"]

    def on_exception(self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException) -> None:
        """Say what it means that an optimiser cannot factorise its statistics."""
        if isinstance(exception, torch.linalg.LinAlgError):  # type: ignore[attr-defined]  # public, not in __all__
            raise self.diverged(trainer, f"The optimiser failed at step {trainer.global_step + 1}") from exception

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Test the weights, which the last step changed after its loss."""
        if not finite_weights(pl_module):
            raise self.diverged(trainer, f"Step {trainer.global_step} left weights that are not finite")


def finite_weights(module: nn.Module) -> bool:
    """Whether all parameters are finite."""
    return all(bool(weights.isfinite().all()) for weights in module.parameters())


def write_batch(path: Path, batch: Batch) -> None:
    """Write a batch as safetensors; names are those of streams and fields, such as "bvp.points.x"."""
    tensors = {
        name: tensor.detach().cpu().clone(memory_format=torch.contiguous_format) for name, tensor in _named(batch)
    }
    replace_whole(path, lambda draft: safetensors.torch.save_file(tensors, draft))


def _named(part: Any, name: str = "") -> Iterator[tuple[str, Tensor]]:
    """Tensors in dictionaries and named tuples, with dotted names."""
    if isinstance(part, Tensor):
        yield name.removeprefix("."), part
    elif part is not None:
        for key, inner in (part if isinstance(part, Mapping) else part._asdict()).items():
            yield from _named(inner, f"{name}.{key}")
