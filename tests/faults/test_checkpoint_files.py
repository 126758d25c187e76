"""Processes that are killed while they write checkpoints, and checkpoints that are damaged afterwards."""

from __future__ import annotations

import multiprocessing
import os
import random
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from hno.training import saving
from hno.training.checkpoint import find_checkpoint, load_operator
from hno.training.saving import (
    BEST,
    LAST,
    PREVIOUS,
    RESUMED,
    CheckpointError,
    is_sound,
    read_content,
    remove_drafts,
    seal,
    write_checkpoint,
)
from tests.faults.checkpoints import operator_content

FORK = multiprocessing.get_context("fork")
POINTS = 8
"""Calls that leave something on the disk while one checkpoint is written: see `killed_before`."""


def numbered(step: int) -> dict[str, object]:
    return {"step": step, "weight": torch.full((64, 64), float(step))}


def killed_before(path: Path, point: int) -> None:
    """Replace a checkpoint by that of step 3, and die at one of the calls that matter, or at none of them."""
    calls = 0

    def fatal(call: Callable[..., object]) -> Callable[..., object]:
        def counted(*arguments: object, **options: object) -> object:
            nonlocal calls
            calls += 1
            if calls == point:
                os._exit(9)
            return call(*arguments, **options)

        return counted

    class Dying:
        """A file whose writing is half done when it is interrupted."""

        def __init__(self, file: object) -> None:
            self.file, self.fileno = file, file.fileno
            self.flush, self.write = fatal(file.flush), self.halves

        def halves(self, whole: bytes) -> None:
            for part in (whole[: len(whole) // 2], whole[len(whole) // 2 :]):
                fatal(self.file.write)(part)
                self.file.flush()

        def __enter__(self) -> Dying:
            return self

        def __exit__(self, *error: object) -> None:
            self.file.close()

    opened = Path.open
    Path.open = lambda self, mode="r", *others: (
        Dying(opened(self, mode)) if "w" in mode else opened(self, mode, *others)
    )
    os.fsync, Path.replace, Path.chmod = fatal(os.fsync), fatal(Path.replace), fatal(Path.chmod)
    write_checkpoint(numbered(3), path)
    os._exit(0 if calls == POINTS else 1)


@pytest.mark.parametrize("name", [LAST, BEST])
@pytest.mark.parametrize("point", range(1, POINTS + 2))
def test_killed_between_any_two_calls_there_is_a_sound_checkpoint(tmp_path: Path, name: str, point: int) -> None:
    """The calls: two halves of the content, flush, fsync, chmod, both renames, fsync of the folder; or none of them."""
    for step in (1, 2):
        write_checkpoint(numbered(step), tmp_path / name)
    process = FORK.Process(target=killed_before, args=(tmp_path / name, point))
    process.start()
    process.join(60)
    if name == LAST:
        assert process.exitcode == (0 if point > POINTS else 9)
    found = read_content(find_checkpoint(tmp_path, RESUMED if name == LAST else [BEST]))
    assert found["step"] in (2, 3)
    assert bool((found["weight"] == found["step"]).all())
    remove_drafts(tmp_path)
    kept = {path.name for path in tmp_path.iterdir()}
    assert kept <= {LAST, PREVIOUS} if name == LAST else kept == {BEST}
    assert all(map(is_sound, tmp_path.iterdir()))


def test_two_are_kept_and_the_last_moves_after_its_successor_is_verified(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for step in (1, 2, 3):
        write_checkpoint(numbered(step), tmp_path / LAST)
    assert [read_content(tmp_path / name)["step"] for name in RESUMED] == [3, 2]
    sealed = seal(numbered(4))
    monkeypatch.setattr(saving, "seal", lambda content: sealed)
    monkeypatch.setattr(os, "fsync", lambda handle: os.truncate(handle, 100))
    with pytest.raises(OSError, match="what was read back is not what was written"):
        write_checkpoint(numbered(4), tmp_path / LAST)
    assert [read_content(tmp_path / name)["step"] for name in RESUMED] == [3, 2]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(RESUMED)


def test_a_damaged_one_never_takes_the_place_of_the_sound_one_before_it(tmp_path: Path) -> None:
    for step in (1, 2):
        write_checkpoint(numbered(step), tmp_path / LAST)
    (tmp_path / LAST).write_bytes(b"")
    write_checkpoint(numbered(3), tmp_path / LAST)
    assert [read_content(tmp_path / name)["step"] for name in RESUMED] == [3, 1]


def test_nothing_is_written_to_the_folder_of_temporary_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(elsewhere))
    elsewhere.chmod(0o500)
    write_checkpoint(numbered(1), tmp_path / "run" / LAST)
    assert not list(elsewhere.iterdir())
    assert [path.name for path in (tmp_path / "run").iterdir()] == [LAST]


def damage(whole: bytes, generator: random.Random) -> bytes:
    """One byte changed, or only the beginning left."""
    place = generator.randrange(len(whole))
    if generator.random() < 0.3:
        return whole[:place]
    return whole[:place] + bytes([whole[place] ^ generator.randrange(1, 256)]) + whole[place + 1 :]


def test_every_flip_and_truncation_is_detected_and_the_one_before_is_used(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for step in (1, 2):
        write_checkpoint(operator_content() | {"step": step}, tmp_path / LAST)
    whole, generator = (tmp_path / LAST).read_bytes(), random.Random(0)
    cases = [damage(whole, generator) for _ in range(200)] + [b"", whole[:-1], whole + b"\0", whole + whole]
    for case in cases:
        (tmp_path / LAST).write_bytes(case)
        caplog.clear()
        for read in (read_content, load_operator):
            with pytest.raises(CheckpointError, match=f"{tmp_path / LAST} is not a readable checkpoint"):
                read(tmp_path / LAST)
        assert find_checkpoint(tmp_path, RESUMED) == tmp_path / PREVIOUS
        assert f"{tmp_path / LAST} is damaged and passed over." in caplog.text
    load_operator(tmp_path)
    (tmp_path / PREVIOUS).write_bytes(b"")
    with pytest.raises(
        CheckpointError, match=rf"Every checkpoint in {tmp_path} is damaged: last\.ckpt, previous\.ckpt"
    ):
        find_checkpoint(tmp_path)
    print(f"{len(cases)} cases: flips and truncations of a checkpoint")


def write_on(folder: Path) -> None:
    """Write checkpoint after checkpoint."""
    step = read_content(find_checkpoint(folder, RESUMED))["step"]
    remove_drafts(folder)
    while True:
        step += 1
        write_checkpoint(numbered(step), folder / LAST)
        write_checkpoint(numbered(step), folder / BEST)


@pytest.mark.slow
def test_killed_at_random_moments_there_is_a_sound_checkpoint(tmp_path: Path) -> None:
    generator, kills = random.Random(0), 300
    write_checkpoint(numbered(0), tmp_path / LAST)
    write_checkpoint(numbered(0), tmp_path / BEST)
    before = 0
    for _ in range(kills):
        process = FORK.Process(target=write_on, args=(tmp_path,))
        process.start()
        time.sleep(generator.uniform(0.01, 0.1))
        process.kill()
        process.join()
        assert is_sound(tmp_path / BEST)
        step = read_content(find_checkpoint(tmp_path, RESUMED))["step"]
        assert step >= before
        before = step
        assert len(list(tmp_path.iterdir())) <= 4, "more than the three checkpoints and one draft"
    assert before > 0
    print(f"{kills} cases: SIGKILL while checkpoints are written, {before} were written")
