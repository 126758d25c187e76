"""Full, limited and read-only disks: what was there stays whole, no half file is left, and a message says why."""

from __future__ import annotations

import errno
import json
import os
import re
import resource
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import safetensors
import torch

from hno.cli import evaluate, pages
from hno.cli.curve import CurveLogger
from hno.cli.results import Results
from hno.data import folders
from hno.data.labels import Request, label_bytes, label_set, labels_for
from hno.data.store import read_labels, start_count, write_labels
from hno.evaluation.outcome import Played
from hno.games import make
from hno.training.fit import _check_room
from hno.training.saving import LAST, read_content, write_checkpoint
from tests.cli import conftest as cli
from tests.cli.conftest import Command, save_random
from tests.data import conftest
from tests.data.conftest import Asked
from tests.fakes import fake_labels
from tests.operators.conftest import small_operator
from tests.report.folders import make_results, write_run

asked, command, clean_globals, no_pages = conftest.asked, cli.command, cli.clean_globals, cli.no_pages
REQUEST = Request((1.0, 5.0), 6, 0, "train")


def mounted(folder: Path, options: str) -> None:
    found = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], capture_output=True, check=False)
    if found.returncode:
        pytest.skip("only root may mount a disk")


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 4 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted(folder, "size=4m")
    yield folder
    subprocess.run(["umount", "-l", folder], check=True)


@pytest.fixture
def quota(tmp_path: Path) -> Iterator[Path]:
    """A folder in which no file grows beyond what `fill` leaves."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield tmp_path
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture(params=["disk", "quota"])
def place(request: pytest.FixtureRequest) -> Path:
    return request.getfixturevalue(request.param)


def fill(place: Path, room: int = 8192) -> None:
    """Leave so much room, two pages by default."""
    if not os.path.ismount(place):
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
        return
    free = os.statvfs(place)
    (place / "filler").write_bytes(bytes(free.f_bavail * free.f_frsize - room))


def read_only(folder: Path) -> None:
    subprocess.run(["mount", "-o", "remount,ro", folder], check=True)


def files(place: Path) -> dict[str, bytes]:
    found = [path for path in place.rglob("*") if path.is_file() and path.name != "filler"]
    return {str(path.relative_to(place)): path.read_bytes() for path in found}


def test_a_label_file_that_does_not_fit_leaves_the_one_that_was_there(place: Path) -> None:
    path, game = place / "labels.safetensors", make("narrow_road")
    write_labels(path, fake_labels(game, count=1), {})
    before = files(place)
    fill(place)
    with pytest.raises(OSError, match=rf"{path} could not be written .*Free some space"):
        write_labels(path, fake_labels(game, count=40, seed=1), {})
    assert files(place) == before
    assert read_labels(path)[0].starts == 1


def test_results_that_do_not_fit_leave_those_that_were_there(place: Path) -> None:
    results = Results(place / "results.json", {"game": "any"})
    before = files(place)
    fill(place)
    with pytest.raises(OSError, match=r"results\.json could not be written .*what was there before is whole"):
        results.update(table=[0.5] * 10_000)
    assert files(place) == before
    assert json.loads((place / "results.json").read_text())["status"] == "running"


def test_a_checkpoint_that_does_not_fit_leaves_those_that_were_there(place: Path) -> None:
    path = place / LAST
    write_checkpoint({"step": 1}, path)
    before = files(place)
    fill(place)
    with pytest.raises(OSError, match=r"last\.ckpt could not be written .*what was there before is whole"):
        write_checkpoint({"weights": torch.zeros(10_000)}, path)
    assert files(place) == before
    assert read_content(path) == {"step": 1}


def test_a_page_that_does_not_fit_leaves_the_one_that_was_there(place: Path) -> None:
    made = make_results("narrow_road", "sno", "tanh", 0, np.random.default_rng(0))
    write_run(place / "run", made, extras=False)
    (place / "run" / "report.html").write_text("the page before")
    before = files(place)
    fill(place)
    line = pages.write(place / "run")
    assert line.startswith("Page: could not be written (")
    assert re.search(r"report\.html could not be written .*what was there before is whole", line)
    assert "\n" not in line
    assert files(place) == before


def test_a_curve_that_does_not_fit_keeps_its_rows(place: Path) -> None:
    curve = CurveLogger(place / "metrics.csv")
    for step in range(3):
        curve.log_metrics({"loss": 0.5}, step)
    before = files(place)
    fill(place, 4096 if os.path.ismount(place) else len(before["metrics.csv"]) + 3)
    wide = {f"loss/{number}": 0.5 for number in range(2000)}
    for row in (wide, {"loss": "5" * 9000}):  # a file with more columns, and one more row
        curve.columns = ["loss", "step"]
        with pytest.raises(OSError, match=r"metrics\.csv could not be written .*what was there before is whole"):
            curve.log_metrics(row, 3)
        assert files(place) == before


def test_a_set_that_does_not_fit_keeps_its_shards(place: Path, asked: Asked) -> None:
    game = make("narrow_road")
    labels_for(game, [REQUEST._replace(starts=1)], place, workers=1)
    before = files(place)
    fill(place)
    with pytest.raises(OSError, match=r"could not be written|need .* MB"):
        labels_for(game, [REQUEST._replace(starts=100)], place, workers=1)
    assert files(place) == before
    assert label_set(game, REQUEST, place).read(1).starts == 1


def test_a_full_disk_ends_the_labels_command_with_one_message(disk: Path, command: Command, asked: Asked) -> None:
    fill(disk)
    run = command("labels", "game=narrow_road", "theta=1,1", "n=100", f"cache={disk}", "workers=1")
    assert run.code == 1
    assert "Free some space" in run.text
    assert "Traceback" not in run.text
    assert asked.total() == 0


@pytest.mark.usefixtures("cache")
def test_a_disk_that_fills_up_ends_an_evaluation_with_one_message(
    disk: Path, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint, original = save_random(tmp_path / "random" / "last.ckpt"), evaluate.numbers_of

    def numbers_of(*arguments: Any) -> Played:
        fill(disk, 0)
        return original(*arguments)

    monkeypatch.setattr(evaluate, "numbers_of", numbers_of)
    options = "theta=1,1", "starts=4", "workers=1", "dt=0.1", "residuals=false"
    run = command("evaluate", f"checkpoint={checkpoint}", *options, folder=disk / "run")
    assert run.code == 1
    assert "Traceback" not in run.text
    assert run.text.count("results.json could not be written (No space left on device)") == 1
    assert run.results["status"] == "running"
    assert not list(run.folder.glob(".*.*"))


def test_a_read_only_cache_is_read_and_refused_before_solving(disk: Path, asked: Asked) -> None:
    game = make("narrow_road")
    labels_for(game, [REQUEST], disk, workers=1)
    before = files(disk)
    read_only(disk)
    (found,), _ = labels_for(game, [REQUEST], disk, workers=1)
    assert found.starts == asked.total() == 6
    with pytest.raises(OSError, match=r"Labels cannot be written.*\$HNO_CACHE"):
        labels_for(game, [REQUEST._replace(starts=7)], disk, workers=1)
    assert asked.total() == 6
    assert files(disk) == before


@pytest.mark.parametrize("name", ["narrow_road", "lane_change", "drone", "intersection"])
def test_the_size_of_labels_is_known_before(tmp_path: Path, name: str) -> None:
    game = make(name)
    path = tmp_path / "labels.safetensors"
    write_labels(path, fake_labels(game, [1.0] * game.players, 128), {})
    assert 0.85 < label_bytes(game, 128) / path.stat().st_size <= 1


def free(monkeypatch: pytest.MonkeyPatch, size: float) -> None:
    monkeypatch.setattr(folders.shutil, "disk_usage", lambda folder: SimpleNamespace(free=size))


@pytest.mark.parametrize("starts", [1, 128, 100_000])
def test_labels_that_cannot_fit_are_refused_with_the_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: Asked, starts: int
) -> None:
    free(monkeypatch, label_bytes(make("narrow_road"), starts) - 1)
    with pytest.raises(OSError, match=rf"{starts} start states need [\d.,]+ MB, but .* has [\d.,]+ MB free") as error:
        labels_for(make("narrow_road"), [REQUEST._replace(starts=starts)], tmp_path, workers=1)
    assert "$HNO_CACHE" in str(error.value)
    assert asked.total() == 0


def test_checkpoints_that_cannot_fit_are_refused_with_the_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    operator = small_operator(make("narrow_road"))
    free(monkeypatch, sum(parameter.nbytes for parameter in operator.parameters()))
    with pytest.raises(OSError, match=r"Checkpoints need [\d.,]+ MB, but"):
        _check_room(tmp_path / "not" / "yet", operator)
    free(monkeypatch, 1e9)
    _check_room(tmp_path / "not" / "yet", operator)


@pytest.mark.parametrize("read", [read_labels, start_count])
@pytest.mark.parametrize("error", [OSError(errno.ENODEV, "No such device"), OSError("No such device (os error 19)")])
def test_a_disk_that_cannot_map_files_is_named_with_a_way_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read: Callable[[Path], object], error: OSError
) -> None:
    def safe_open(*arguments: object, **options: object) -> None:
        raise error

    monkeypatch.setattr(safetensors, "safe_open", safe_open)
    with pytest.raises(OSError, match=r"cannot map files into memory.*\$HNO_CACHE"):
        read(tmp_path / "labels.safetensors")
