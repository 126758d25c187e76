"""A training step must not wait for its device: a single scalar that is read stops everything behind it."""

from __future__ import annotations

from typing import Any

import pytest
from torch.utils._python_dispatch import TorchDispatchMode

from hno.operators import ValueOperator
from hno.operators.inputs import distinct_types
from hno.types import Batch
from tests.operators.conftest import GAMES, MakeOperator
from tests.training.test_training import random_batch

WAITING = ("_local_scalar_dense", "nonzero", "_unique2", "unique_dim", "masked_select", "equal", "is_nonzero")
"""Operators of ATen that read from a device."""


class NeverWait(TorchDispatchMode):
    """Refuse operators that read from a device."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func.overloadpacket.__name__ in WAITING:
            raise AssertionError(f"{func} waits for the device")
        return func(*args, **(kwargs or {}))


def with_tables(batch: Batch) -> Batch:
    """As the datamodule makes batches."""
    return {name: sample._replace(types=distinct_types(sample.points.theta)) for name, sample in batch.items()}


@pytest.mark.parametrize("game", GAMES)
@pytest.mark.parametrize("options", [{}, {"exact_terminal": True, "balance": True, "hardest": 0.5}])
def test_a_training_step_does_not_wait_for_the_device(
    make_operator: MakeOperator, monkeypatch: pytest.MonkeyPatch, game: str, options: dict[str, Any]
) -> None:
    monkeypatch.setattr(ValueOperator, "log", lambda *args, **kwargs: None)
    monkeypatch.setattr(ValueOperator, "log_dict", lambda *args, **kwargs: None)
    operator = make_operator(game, **options)
    batch = with_tables(random_batch(operator))
    with NeverWait():
        operator.training_step(batch, 0).backward()


def test_searching_for_types_does(make_operator: MakeOperator) -> None:
    operator = make_operator()
    with pytest.raises(AssertionError, match="waits for the device"), NeverWait():
        operator.field(random_batch(operator)["bvp"].points)
