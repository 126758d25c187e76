from __future__ import annotations

import pytest

from tests.cli.conftest import SMOKE, Command, refused


@pytest.mark.usefixtures("no_labels")
@pytest.mark.parametrize("precision", ["bf16-true", "8"])
def test_another_precision_is_refused_before_any_work(command: Command, precision: str) -> None:
    run = command("train", *SMOKE, f"trainer.precision={precision}")
    refused(run, "trainer.precision must be 32-true")
    assert not run.folder.exists()
