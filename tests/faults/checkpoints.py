"""Small checkpoints for the tests of this folder."""

from __future__ import annotations

import copy
import functools
from pathlib import Path
from typing import Any

import torch

from hno.training import Fitted
from hno.training.checkpoint import Provenance, record
from tests.operators.conftest import architecture, small_operator
from tests.training.test_fit import EVERY, STEPS, trained

__all__ = ["EVERY", "STEPS", "content", "operator_content", "trained"]


def operator_content(**entries: Any) -> dict[str, Any]:
    """A checkpoint of a random operator, as training writes it, with some entries of its record replaced."""
    whole = copy.deepcopy(_operator_content())
    whole["hno"] |= entries
    return whole


@functools.cache
def _operator_content() -> dict[str, Any]:
    operator = small_operator(width=4, depth=1)
    whole = record(operator.game, architecture(width=4, depth=1), Provenance("hno", [(1.0, 1.0)], 7, "hash"))
    return whole | {"state_dict": {f"operator.{name}": weight for name, weight in operator.state_dict().items()}}


def content(path: Path) -> dict[str, Any]:
    """What a checkpoint holds."""
    return torch.load(path, weights_only=True)


def run(folder: Path, **changes: Any) -> Fitted:
    """A training of `STEPS` steps that leaves its three checkpoints."""
    return trained(folder, **changes)[1]
