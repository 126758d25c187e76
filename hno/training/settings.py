"""How an operator is trained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from hno.training.adaptive import Adaptive

PRECISIONS = ("32-true", "32")
"""Precisions of Lightning in which a training is sound. The others move the game, its simulation and the scales to 16
or 64 bits, or compute residuals in 16; the step gains nothing by them, since derivatives are taken in 32 anyway."""
LONG = 20_000
"""Steps from which on compiling pays: it takes some ten seconds and saves about a millisecond a step."""


@dataclass(frozen=True)
class Settings:
    """How an operator is trained: a field for every choice, all with defaults."""

    steps: int = 2000
    schedule_steps: int | None = None
    """Steps over which the rate falls and labels are added; `steps` by default. Those beyond keep the final rate."""
    optimizer: Mapping[str, Any] = field(default_factory=lambda: {"name": "soap"})
    """Name and options, see `hno.training.optimizers.make_optimizer`."""
    validate_every: int = 500
    """Steps between validations and checkpoints."""
    stop_when_safe: bool = False
    """End the training as soon as no validation start collides."""
    dt: float = 0.02
    """Time for which validation episodes hold a control, s."""
    accelerator: str = "auto"
    devices: int | str | list[int] = 1
    """How many devices, or their numbers in a list; each has a process of its own and its share of every batch."""
    precision: Any = "32-true"
    """One of `PRECISIONS`."""
    gradient_clip_val: float | None = None
    strategy: str = "auto"
    """"auto", "single_device" or "ddp", which is "auto" where there are several devices."""
    profiler: str | None = None
    """"simple", "advanced" or "pytorch"; it writes into the folder."""
    lightning: Mapping[str, Any] = field(default_factory=dict)
    """Further arguments of Lightning's trainer, see `hno.training.trainer.CONTROLLED` for those that are none."""
    polish: int = 0
    """Iterations of L-BFGS on all labelled rows after the last step."""
    adaptive: Adaptive = field(default_factory=Adaptive)
    """Labels that are added while training."""
    compile: bool = True
    """`torch.compile` in runs of at least `LONG` steps."""

    @property
    def planned(self) -> int:
        """Steps over which everything that changes with them is laid out."""
        return self.schedule_steps or self.steps

    def __post_init__(self) -> None:
        """Refuse, with a ValueError, a precision in which simulation and residuals would be wrong."""
        if str(self.precision) not in PRECISIONS:
            raise ValueError(
                f"trainer.precision must be {PRECISIONS[0]}; got {self.precision!r}. Others would compute residuals or "
                "move the game and its simulation in 16 or 64 bits."
            )
