from __future__ import annotations

import multiprocessing
import os
import random
import signal
import time
from collections.abc import Callable, Sequence
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

    def started(cache: Path, starts: int = STARTS, workers: int = 1) -> BaseProcess:
        process = context.Process(target=write, args=(cache, starts, workers))
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
    """Kill a process and its workers some time after it has written a shard; False if it was done before."""
    before = written(cache)
    while process.is_alive() and written(cache) == before:
        time.sleep(0.001)
    process.join(delay)
    if process.is_alive():
        os.killpg(process.pid, signal.SIGKILL)
    process.join(120)
    return process.exitcode == -signal.SIGKILL


@pytest.fixture(scope="module")
def whole(start: Start, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of a run that nobody interrupted."""
    cache = tmp_path_factory.mktemp("whole")
    assert finished(start(cache))
    return tree(cache)


def killed_and_finished(start: Start, cache: Path, growing: Sequence[int], workers: int = 1) -> int:
    """Kill runs that ask for more and more starts, then let one finish.

    Returns:
        How many were killed before they were done.
    """
    chance = random.Random(0)
    kills = [kill(start(cache, starts, workers), cache, chance.uniform(0, 0.03)) for starts in growing]
    assert finished(start(cache, STARTS, workers))
    return sum(kills)


def test_uninterrupted_run_leaves_shards_and_manifests_only(whole: dict[str, bytes]) -> None:
    names = [f"shard-{shard:05}.safetensors" for shard in range(STARTS // SHARD)] + ["manifest.json"]
    assert sorted(Path(path).name for path in whole) == sorted(names * len(THETAS))


def test_killed_runs_that_are_run_again_leave_what_one_run_would(
    start: Start, whole: dict[str, bytes], tmp_path: Path
) -> None:
    assert killed_and_finished(start, tmp_path, range(14, STARTS, 4)) >= 8
    assert tree(tmp_path) == whole


@pytest.mark.slow
def test_killed_runs_with_workers_leave_what_one_run_would(
    start: Start, whole: dict[str, bytes], tmp_path: Path
) -> None:
    assert killed_and_finished(start, tmp_path, range(14, STARTS, 10), workers=2) >= 3
    assert tree(tmp_path) == whole


@pytest.mark.parametrize("starts", [(STARTS, STARTS), (STARTS, 45), (13, STARTS)])
def test_two_runs_at_once_leave_what_one_would(
    start: Start, whole: dict[str, bytes], tmp_path: Path, starts: tuple[int, int]
) -> None:
    assert finished(*[start(tmp_path, count) for count in starts])
    assert tree(tmp_path) == whole
