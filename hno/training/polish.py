"""L-BFGS on one large batch, after the last step."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from hno.operators.base import ValueOperator
from hno.types import Batch


def polish(operator: ValueOperator, batch: Batch, iterations: int) -> tuple[float, float]:
    """Lower the loss of a batch by L-BFGS with a line search; weights that are no better are put back.

    Args:
        operator: a trained operator, changed in place.
        batch: fixed for all iterations.
        iterations: at most so many.

    Returns:
        The loss before and after.
    """
    weights = copy.deepcopy(operator.net.state_dict())
    optimizer = torch.optim.LBFGS(
        operator.net.parameters(), max_iter=iterations, history_size=30, line_search_fn="strong_wolfe"
    )

    def loss() -> Tensor:
        terms = operator.loss_terms(batch)
        return torch.stack([operator.weights[name] * term for name, term in terms.items()]).sum()

    def closure() -> float:
        optimizer.zero_grad()
        total = loss()
        total.backward()
        return float(total.detach())

    with torch.no_grad():
        before = float(loss())
    optimizer.step(closure)
    with torch.no_grad():
        after = float(loss())
    if not after <= before:
        operator.net.load_state_dict(weights)
        return before, before
    return before, after
