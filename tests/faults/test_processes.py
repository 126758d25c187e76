"""Many processes, one set of labels: solved once, waited for aloud, and given back by whoever is killed."""

from __future__ import annotations

import errno
import fcntl
import logging
import multiprocessing
import os
import platform
import time
from collections.abc import Callable, Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path

import joblib
import pytest

from hno.data import folders
from hno.data import labels as label_data
from hno.data.folders import claimed, locked
from hno.data.labels import Request, label_set, labels_for
from hno.games import make
from hno.pontryagin import threads
from tests.data import conftest
from tests.data.conftest import Asked
from tests.faults.solving import REQUEST, SHARD, ask

asked = conftest.asked
Ask = Callable[..., BaseProcess]


@pytest.fixture(scope="module")
def start() -> Iterator[Ask]:
    """Start processes that have imported what they need; what is left of them is killed."""
    context, started = multiprocessing.get_context("forkserver"), list[BaseProcess]()
    context.set_forkserver_preload(["tests.faults.solving"])

    def asking(*arguments: object) -> BaseProcess:
        started.append(context.Process(target=ask, args=arguments))
        started[-1].start()
        return started[-1]

    yield asking
    for process in started:
        process.kill()


def solved(cache: Path) -> list[tuple[str, str]]:
    """Which process solved which start, in order."""
    log = Path(f"{cache}.log")
    return [(pid, start) for pid, start in map(str.split, log.read_text().splitlines())] if log.exists() else []


def until(true: Callable[[], bool]) -> None:
    while not true():
        time.sleep(0.01)


def test_ten_processes_solve_what_is_missing_once(start: Ask, tmp_path: Path) -> None:
    cache, ready = tmp_path / "cache", tmp_path / "ready"
    ready.mkdir()
    processes = [start(cache, 0.1, ready) for _ in range(10)]
    until(lambda: len(list(ready.iterdir())) == len(processes))
    (ready / "go").touch()
    for process in processes:
        process.join(120)
    assert [process.exitcode for process in processes] == [0] * 10
    rows = solved(cache)
    assert len(rows) == len({start for _, start in rows}) == REQUEST.starts
    assert len({pid for pid, _ in rows}) > 1  # they share the work
    names = {path.name for path in cache.rglob("*") if path.is_file()}
    shards = {f"shard-{shard:05}.safetensors" for shard in range((REQUEST.starts - 1) // SHARD + 1)}
    assert names <= shards | {"manifest.json", ".lock"}
    print(f"10 processes: {len(rows)} rows, each solved once")


def test_what_a_killed_process_was_solving_is_solved_by_those_who_waited(start: Ask, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    slow = start(cache, 600.0)
    until(lambda: len(solved(cache)) == SHARD)
    quick = start(cache, 0.0)
    until(lambda: len(solved(cache)) == REQUEST.starts)
    assert quick.is_alive()
    slow.kill()
    quick.join(120)
    assert quick.exitcode == 0
    assert len(solved(cache)) == REQUEST.starts + SHARD
    names = [path.name for path in cache.rglob("*") if path.is_file()]
    assert [name for name in names if name.startswith(".claim")] == []


def test_another_process_can_take_a_lock_when_it_is_free_only(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    with claimed(path) as first:
        with claimed(path) as second:
            assert (first, second) == (True, False)
        assert path.exists()
    assert not path.exists()
    with claimed(path) as third:
        assert third


def test_waiting_names_the_lock_and_who_holds_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(folders, "PATIENCE", 0.0)
    monkeypatch.setattr(folders, "POLL", 0.01)
    path = tmp_path / "lock"
    holder = claimed(path)
    assert holder.__enter__()

    def done(record: logging.LogRecord) -> bool:
        holder.__exit__(None, None, None)
        return True

    with caplog.filtering(done), locked(path):
        pass
    assert f"Waiting for {path}, held by process {os.getpid()} on {platform.node()} since 2" in caplog.text


def test_waiting_is_said_ever_more_rarely(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    now = 0.0
    monkeypatch.setattr(folders.time, "monotonic", lambda: now)
    waiting = folders.Waiting()
    for second in range(100):
        now = float(second)
        waiting.announce(tmp_path / "lock")
    assert caplog.text.count("Waiting for") == 5  # after 5, 10, 20, 40 and 80 s
    assert "held by another process" in caplog.text


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_is_named_with_a_way_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: Asked, number: int
) -> None:
    def flock(*arguments: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.raises(OSError, match=r"has no file locks.*\$HNO_CACHE"):
        labels_for(make("narrow_road"), [Request((1.0, 5.0), 6, 0, "train")], tmp_path, workers=1)
    assert asked.total() == 0


@pytest.mark.filterwarnings("ignore:flock not supported")
def test_a_file_system_that_does_not_know_flock_gets_soft_locks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: Asked
) -> None:
    def flock(*arguments: object) -> None:
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))

    monkeypatch.setattr(fcntl, "flock", flock)
    request = Request((1.0, 5.0), 6, 0, "train")
    labels_for(make("narrow_road"), [request], tmp_path, workers=1)
    assert asked.total() == 6
    assert [p.name for p in sorted(label_set(make("narrow_road"), request, tmp_path).folder.iterdir())] == [
        "manifest.json", "shard-00000.safetensors",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({}, 12),
        ({"SLURM_CPUS_PER_TASK": "3"}, 3),
        ({"SLURM_CPUS_PER_TASK": "40"}, 12),
        ({"SLURM_CPUS_PER_TASK": ""}, 12),
    ],
)
def test_the_cores_of_a_job_are_not_those_of_the_machine(
    monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], expected: int
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr(joblib, "cpu_count", lambda: 12)
    monkeypatch.delenv("SLURM_CPUS_PER_TASK", raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert threads.cores() == expected


def test_label_workers_are_as_many_as_the_job_has_cores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: Asked
) -> None:
    told: list[int] = []

    class Pool:
        def __init__(self, n_jobs: int, **options: object) -> None:
            told.append(n_jobs)

        def __call__(self, calls: Iterator[tuple[Callable[..., object], tuple[object, ...], object]]) -> list[object]:
            return [function(*arguments) for function, arguments, _ in calls]

    monkeypatch.setattr(label_data, "cores", lambda: 3)
    monkeypatch.setattr(joblib, "Parallel", Pool)
    labels_for(make("narrow_road"), [Request((1.0, 5.0), 128 * 5, 0, "train")], tmp_path)
    assert told == [3]
