"""A training step must not wait for its device: a single scalar that is read stops everything behind it."""

from __future__ import annotations

from typing import Any

import pytest
from torch.utils._python_dispatch import TorchDispatchMode

from tests.operators.conftest import GAMES, MakeModule, MakeOperator, random_batch, with_tables

WAITING = ("_local_scalar_dense", "nonzero", "_unique2", "unique_dim", "masked_select", "equal", "is_nonzero")
"""Operators of ATen that read from a device."""


class NeverWait(TorchDispatchMode):
    """Refuse operators that read from a device."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func.overloadpacket.__name__ in WAITING:
            raise AssertionError(f"{func} waits for the device")
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("game", GAMES)
@pytest.mark.parametrize("options", [{}, {"exact_terminal": True, "balance": True, "hardest": 0.5, "members": 3}])
def test_a_training_step_does_not_wait_for_the_device(
    make_module: MakeModule, game: str, options: dict[str, Any]
) -> None:
    module = make_module(game, **options)
    batch = with_tables(random_batch(module.operator.game))
    with NeverWait():
        module.training_step(batch, 0).backward()


def test_searching_for_types_does(make_operator: MakeOperator) -> None:
    operator = make_operator()
    with pytest.raises(AssertionError, match="waits for the device"), NeverWait():
        operator.field(random_batch(operator.game)["bvp"].points)
