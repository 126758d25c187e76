from __future__ import annotations

import contextlib
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest

from tests.data.writer import SHARD, THETAS, write

STARTS = 60

Start = Callable[..., BaseProcess]


@pytest.fixture(scope="module")
def start() -> Start:
    """Start a writer in a fresh process that has imported what it needs."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.data.writer"])

    def started(cache: Path, starts: int = STARTS) -> BaseProcess:
        process = context.Process(target=write, args=(cache, starts))
        process.start()
        return process

    return started


def finished(*processes: BaseProcess) -> bool:
    for process in processes:
        process.join(120)
    return all(process.exitcode == 0 for process in processes)


def tree(cache: Path) -> dict[str, bytes]:
    files = [path for path in cache.rglob("*") if path.is_file() and path.name != ".lock"]
    return {str(path.relative_to(cache)): path.read_bytes() for path in files}


def written(cache: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in cache.rglob("shard-*")}


def kill(process: BaseProcess, cache: Path, delay: float) -> bool:
    """Kill a process some time after it has written a shard; False if it was done before."""
    before = written(cache)
    while process.is_alive() and written(cache) == before:
        time.sleep(0.001)
    process.join(delay)
    if process.is_alive():
        process.kill()
    process.join(120)
    return process.exitcode == -signal.SIGKILL


@pytest.fixture(scope="module")
def whole(start: Start, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of a run that nobody interrupted."""
    cache = tmp_path_factory.mktemp("whole")
    assert finished(start(cache))
    return tree(cache)


def test_uninterrupted_run_leaves_shards_and_manifests_only(whole: dict[str, bytes]) -> None:
    names = [f"shard-{shard:05}.safetensors" for shard in range(STARTS // SHARD)] + ["manifest.json"]
    assert sorted(Path(path).name for path in whole) == sorted(names * len(THETAS))


def test_killed_runs_that_are_run_again_leave_what_one_run_would(
    start: Start, whole: dict[str, bytes], tmp_path: Path
) -> None:
    """Every run asks for more starts than the one before."""
    chance = random.Random(0)
    kills = [kill(start(tmp_path, starts), tmp_path, chance.uniform(0, 0.03)) for starts in range(14, STARTS, 4)]
    assert sum(kills) >= 8
    assert finished(start(tmp_path))
    assert tree(tmp_path) == whole


def launch(cache: Path, starts: int) -> subprocess.Popen[bytes]:
    """A writer with two worker processes, all in one process group."""
    text = f"from pathlib import Path; from tests.data.writer import write; write(Path({str(cache)!r}), {starts}, 2)"
    root = Path(__file__).parents[2]
    return subprocess.Popen([sys.executable, "-c", text], cwd=root, process_group=0, stderr=subprocess.DEVNULL)


@pytest.mark.slow
def test_killed_runs_with_workers_leave_what_one_run_would(whole: dict[str, bytes], tmp_path: Path) -> None:
    chance, kills = random.Random(0), 0
    for starts in (14, 34, 54):
        run, before = launch(tmp_path, starts), written(tmp_path)
        while run.poll() is None and written(tmp_path) == before:
            time.sleep(0.001)
        time.sleep(chance.uniform(0, 0.02))
        with contextlib.suppress(ProcessLookupError):
            os.killpg(run.pid, signal.SIGKILL)
        kills += run.wait() == -signal.SIGKILL
    assert kills >= 2
    assert launch(tmp_path, STARTS).wait() == 0
    assert tree(tmp_path) == whole


@pytest.mark.parametrize("starts", [(STARTS, STARTS), (STARTS, 45), (13, STARTS)])
def test_two_runs_at_once_leave_what_one_would(
    start: Start, whole: dict[str, bytes], tmp_path: Path, starts: tuple[int, int]
) -> None:
    assert finished(*[start(tmp_path, count) for count in starts])
    assert tree(tmp_path) == whole
