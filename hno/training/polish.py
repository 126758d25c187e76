"""L-BFGS on one large batch, after the last step."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor

from hno.training.module import TrainingModule
from hno.types import Batch


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
