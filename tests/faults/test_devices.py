"""Several devices train one operator from the command line; what they cannot do is refused before any work."""

from __future__ import annotations

import csv
import os
import signal
from pathlib import Path

import pytest

import hno
from hno.training.saving import LAST, read_content
from hno.training.settings import Settings
from hno.training.trainer import device_count, make_trainer
from tests.cli import conftest
from tests.cli.conftest import SMOKE, Command, refused
from tests.faults.signalled import started

command, no_labels, clean_globals, no_pages = (
    conftest.command, conftest.no_labels, conftest.clean_globals, conftest.no_pages,
)  # fmt: skip
TWO = ("trainer.accelerator=cpu", "trainer.devices=2")


@pytest.mark.parametrize(("devices", "count"), [(1, 1), ("1", 1), ("auto", 1), (2, 2), ("7", 7)])
def test_devices_are_counted(devices: int | str, count: int) -> None:
    assert device_count(Settings(accelerator="cpu", devices=devices)) == count


def test_alone_a_process_trains_with_the_usual_strategy(tmp_path: Path) -> None:
    assert make_trainer(Settings(accelerator="cpu"), tmp_path, [], []).world_size == 1


@pytest.mark.parametrize(
    ("words", "fragment"),
    [
        (("trainer.devices=0",), "trainer.devices"),
        (("trainer.devices=1.5",), "trainer.devices"),
        (("trainer.devices=[0]",), "trainer.devices"),
        (("trainer.accelerator=abacus",), "abacus"),
        (("trainer.precision=8",), "trainer.precision"),
        (("trainer.precision=transformer-engine",), "trainer.precision"),
        (("trainer.devices=2", "trainer.strategy=single_device"), "asks for 2 devices, trainer.strategy=single_device"),
        (("trainer.devices=2", "data.batch_sizes.bvp=1"), "2 devices, but a step has 1 rows of data.batch_sizes.bvp"),
        (("+trainer.num_nodes=2",), "a run trains on one machine"),
        (("+trainer.use_distributed_sampler=true",), "every device takes its share of every batch"),
    ],
)
def test_what_no_trainer_can_do_is_refused_before_labels(
    command: Command, no_labels: None, words: tuple[str, ...], fragment: str
) -> None:
    run = command("train", *SMOKE, "trainer.accelerator=cpu", *words)
    refused(run, fragment)
    assert not (run.folder / "results.json").exists()


@pytest.mark.slow
def test_a_run_on_two_devices_leaves_what_a_run_leaves(command: Command, tmp_path: Path) -> None:
    words = *SMOKE, "optimizer=adam"
    one = command("train", *words, folder=tmp_path / "one")
    two = command("train", *words, *TWO, folder=tmp_path / "two")
    assert (two.code, two.results["status"]) == (0, "finished")
    assert two.results["validation"] == pytest.approx(one.results["validation"], rel=1e-3)
    assert sorted(path.name for path in two.folder.iterdir()) == sorted(path.name for path in one.folder.iterdir())
    curves = [list(csv.DictReader((run.folder / "csv" / "metrics.csv").open())) for run in (one, two)]
    assert [row["step"] for row in curves[0]] == [row["step"] for row in curves[1]]
    goes_on = command("train", f"resume={two.folder}", "trainer.max_steps=14", "trainer.devices=1", folder=two.folder)
    assert (goes_on.code, goes_on.results["steps"]) == (0, 14)


@pytest.mark.slow
def test_a_python_program_trains_on_two_devices(tmp_path: Path, cache: Path) -> None:
    settings = {"experiment": "smoke", "data.types": [[1, 1]], "data.workers": 1, **dict(w.split("=") for w in TWO)}
    policy = hno.train("narrow_road", "hno", tmp_path / "run", settings)
    assert policy.types == [(1.0, 1.0)]
    assert read_content(tmp_path / "run" / LAST)["global_step"] == 10


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT", "SIGKILL"])
def test_a_signal_leaves_no_process(tmp_path: Path, cache: Path, name: str) -> None:
    """Signals of a terminal or a cluster go to all processes."""
    words = ("train", *SMOKE, *TWO, f"hydra.run.dir={tmp_path / 'run'}")
    with started("training", tmp_path, cache, *words) as run:
        run.until((tmp_path / "mark").exists)
        number = getattr(signal, name)
        os.killpg(run.process.pid, number) if name == "SIGTERM" else None
        left = run.end(number, patience=10.0)
    assert left.processes == []
    if name == "SIGKILL":
        assert left.code == -number
        return
    assert left.code == 128 + number
    assert f"Interrupted by {name}" in left.text
    assert read_content(tmp_path / "run" / LAST)["global_step"] in (3, 4)
