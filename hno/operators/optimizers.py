"""Optimisers and learning-rate schedules by name."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from typing import Any

import torch
from pytorch_optimizer import SOAP
from torch import nn
from torch.optim.lr_scheduler import CosineAnnealingLR

from hno.operators.base import Optimizer
from hno.registry import UnknownNameError, unknown_name

OPTIMIZERS: dict[str, Callable[..., torch.optim.Optimizer]] = {
    "adam": torch.optim.Adam,
    "adamw": torch.optim.AdamW,
    "soap": SOAP,
}
SCHEDULES = ("constant", "cosine")


def make_optimizer(name: str, steps: int, lr: float, schedule: str, final_lr: float, **options: Any) -> Optimizer:
    """An optimiser with a schedule over the whole run.

    Args:
        name: one of `OPTIMIZERS`.
        steps: length of the run.
        lr: initial learning rate.
        schedule: one of `SCHEDULES`.
        final_lr: learning rate at the end of the cosine.
        options: further arguments of the optimiser.

    Raises:
        UnknownNameError: unknown optimiser, schedule or option.
    """
    if name not in OPTIMIZERS:
        raise UnknownNameError(unknown_name("optimizer", name, sorted(OPTIMIZERS)))
    if schedule not in SCHEDULES:
        raise UnknownNameError(unknown_name("schedule", schedule, list(SCHEDULES)))
    known = sorted(set(inspect.signature(OPTIMIZERS[name]).parameters) - {"params", "lr", "kwargs"})
    for option in options:
        if option not in known:
            raise UnknownNameError(unknown_name(f"option of {name}", option, known))

    def build(parameters: Iterable[nn.Parameter]) -> dict[str, Any]:
        optimizer = OPTIMIZERS[name](parameters, lr=lr, **options)
        if schedule == "constant":
            return {"optimizer": optimizer}
        cosine = CosineAnnealingLR(optimizer, steps, eta_min=final_lr)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": cosine, "interval": "step"}}

    return build
