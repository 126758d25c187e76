"""A precision in which the simulation would be wrong is refused before any work."""

from __future__ import annotations

from typing import Any

import pytest

from hno.training.settings import Settings

WRONG = ("bf16-true", "16-true", "64-true", "8", "transformer-engine", "bf16-mixed", "16-mixed", "64", "bf16", "half")


@pytest.mark.parametrize("precision", [*WRONG, 16, 64, None])
def test_a_training_in_another_precision_is_refused(precision: Any) -> None:
    with pytest.raises(ValueError, match=r"trainer\.precision must be 32-true; got"):
        Settings(precision=precision)


@pytest.mark.parametrize("precision", ["32-true", "32", 32])
def test_single_precision_is_taken_by_every_name(precision: Any) -> None:
    assert Settings(precision=precision).precision == precision
