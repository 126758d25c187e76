from __future__ import annotations

from pathlib import Path

import pytest

from hno.report.runs import Sweep, load
from tests.report.folders import write_sweep


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep of every recipe with one seed, one job failed and one at work."""
    return write_sweep(tmp_path_factory.mktemp("small") / "sweep", 20)


@pytest.fixture(scope="session")
def small_sweep(small: Path) -> Sweep:
    return load(small)
