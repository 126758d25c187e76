"""Several devices, which would train several runs into one folder, are refused before any work."""

from __future__ import annotations

from pathlib import Path

import pytest

from hno.training.settings import Settings
from hno.training.trainer import make_trainer
from tests.cli import conftest
from tests.cli.conftest import SMOKE, Command, refused

command, no_labels, clean_globals, no_pages = (
    conftest.command, conftest.no_labels, conftest.clean_globals, conftest.no_pages,
)  # fmt: skip


@pytest.mark.parametrize("devices", [2, "2", 7])
def test_a_program_trains_on_one_device(devices: int | str, tmp_path: Path) -> None:
    settings = Settings(accelerator="cpu", devices=devices)
    with pytest.raises(ValueError, match=rf"asks for {devices} devices; a run trains on one"):
        make_trainer(settings, tmp_path, [], [])


@pytest.mark.parametrize("devices", [1, "1", "auto"])
def test_one_device_is_taken(devices: int | str, tmp_path: Path) -> None:
    settings = Settings(accelerator="cpu", devices=devices)
    assert make_trainer(settings, tmp_path, [], []).world_size == 1


@pytest.mark.parametrize(
    ("word", "fragment"),
    [
        ("trainer.devices=2", "trainer.devices=2 asks for 2 devices; a run trains on one"),
        ("trainer.devices=0", "trainer.devices"),
        ("trainer.devices=1.5", "trainer.devices"),
        ("trainer.devices=[0]", "trainer.devices"),
        ("trainer.accelerator=abacus", "abacus"),
        ("trainer.precision=8", "trainer.precision"),
        ("trainer.precision=transformer-engine", "trainer.precision"),
    ],
)
def test_what_no_trainer_can_do_is_refused_before_labels(
    command: Command, no_labels: None, word: str, fragment: str
) -> None:
    run = command("train", *SMOKE, "trainer.accelerator=cpu", word)
    refused(run, fragment)
    assert not (run.folder / "results.json").exists()
