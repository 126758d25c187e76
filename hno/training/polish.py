"""L-BFGS on one large batch, after the last step."""

from __future__ import annotations

import copy
import logging
from typing import Any, final

import lightning as L
import torch
from lightning.fabric.utilities import move_data_to_device
from torch import Tensor

from hno.data import GameData
from hno.training.module import TrainingModule
from hno.training.validation import ClosedLoopValidation
from hno.types import Batch

log = logging.getLogger(__name__)


@final
class Polish(L.Callback):
    """Polishes after the last step, before it is saved, and lets the result be validated.

    Args:
        iterations: at most so many; 0 for none.
        watch: the validation.
    """

    def __init__(self, iterations: int, watch: ClosedLoopValidation) -> None:
        self.iterations, self.watch = iterations, watch

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Polish where the training ends."""
        if not self.iterations or not (trainer.global_step == trainer.max_steps or self.watch.satisfied):
            return
        data = getattr(trainer, "datamodule", None)
        assert isinstance(pl_module, TrainingModule)
        assert isinstance(data, GameData)
        rows = move_data_to_device(data.large_batch(trainer.global_step), pl_module.device)
        before, after = polish(pl_module, rows, self.iterations)
        log.info("L-BFGS: loss %.4g, was %.4g", after, before)
        self.watch.consider(trainer, pl_module)


def polish(module: TrainingModule, batch: Batch, iterations: int) -> tuple[float, float]:
    """Lower the loss of a batch by L-BFGS with a line search; weights that are no better are put back.

    Args:
        module: a trained operator, changed in place, and its objective; terms are not balanced.
        batch: fixed for all iterations.
        iterations: at most so many.

    Returns:
        The loss before and after.
    """
    operator = module.operator
    weights = copy.deepcopy(operator.state_dict())
    settings: dict[str, Any] = {"max_iter": iterations, "history_size": 30, "line_search_fn": "strong_wolfe"}
    optimizer = torch.optim.LBFGS(operator.parameters(), **settings)

    def loss() -> Tensor:
        optimizer.zero_grad()
        total = module.objective.total(module.losses(batch))
        if torch.is_grad_enabled():
            total.backward()
            module.ranks.add_gradients(operator.parameters())
        return total.detach()

    with torch.no_grad():
        before = float(loss())
    optimizer.step(lambda: float(loss()))
    with torch.no_grad():
        after = float(loss())
    if not after <= before:
        operator.load_state_dict(weights)
        return before, before
    return before, after
