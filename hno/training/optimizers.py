"""Optimisers and learning-rate schedules by name."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import torch
from pytorch_optimizer import SOAP, Muon
from torch import nn
from torch.optim.lr_scheduler import LambdaLR

from hno.registry import Registry, UnknownNameError, check_options, unknown_name
from hno.training.module import Optimizer


def muon(
    parameters: Iterable[nn.Parameter],
    lr: float,
    momentum: float = 0.95,
    ns_steps: int = 5,
    weight_decay: float = 0.0,
    adamw_lr: float = 3e-3,
) -> torch.optim.Optimizer:
    """Muon for matrices, with `ns_steps` Newton-Schulz iterations; AdamW at rate `adamw_lr` for biases and slopes."""
    known = list(parameters)
    groups = [{"params": [p for p in known if (p.dim() >= 2) == use], "use_muon": use} for use in (True, False)]
    return Muon(groups, lr, momentum, weight_decay, ns_steps=ns_steps, adamw_lr=adamw_lr)


optimizers: Registry[Any] = Registry("optimizer", "hno.training")
"""Optimisers: classes or functions (parameters, lr=..., **options) -> `torch.optim.Optimizer`."""
FACTORIES: dict[str, Any] = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW, "muon": muon, "soap": SOAP}
for _name, _factory in FACTORIES.items():
    optimizers.register(_name)(_factory)

SCHEDULES = ("constant", "cosine", "linear")
OWN = ("params", "parameters", "lr")
"""Parameters of an optimiser that are no options."""


def make_optimizer(
    name: str, steps: int, lr: float = 3e-3, schedule: str = "cosine", final_lr: float = 3e-5, **options: Any
) -> Optimizer:
    """An optimiser with a schedule over the whole run.

    Args:
        name: registered name.
        steps: length of the run.
        lr: initial learning rate.
        schedule: one of `SCHEDULES`.
        final_lr: learning rate at the end of a schedule that falls.
        options: further arguments of the optimiser.

    Raises:
        UnknownNameError: unknown optimiser, schedule or option.
    """
    factory = optimizers.get(name)
    if schedule not in SCHEDULES:
        raise UnknownNameError(unknown_name("schedule", schedule, list(SCHEDULES)))
    check_options(f"optimizer {name}", factory, options, skip=OWN)

    def factor(step: int) -> float:
        """By which every group's rate is multiplied: 1 at the first step, the end's share after the last."""
        done, end = min(step / steps, 1.0), final_lr / lr
        return end + (1 - end) * ((1 + math.cos(math.pi * done)) / 2 if schedule == "cosine" else 1 - done)

    def build(parameters: Iterable[nn.Parameter]) -> dict[str, Any]:
        optimizer = factory(parameters, lr=lr, **options)
        if schedule == "constant":
            return {"optimizer": optimizer}
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": LambdaLR(optimizer, factor), "interval": "step"}}

    return build
