"""Folders that processes share: locks between them, and room on their disk."""

from __future__ import annotations

import errno
import logging
import os
import platform
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from filelock import BaseFileLock, FileLock, SoftFileLock, Timeout  # now, not while a lock is held

log = logging.getLogger(__name__)

LOCK = ".lock"
"""Name of the lock file of a run's folder, which its process holds while it works: the kernel frees it at its end."""
PATIENCE = 5.0
"""Time after which waiting is announced for the first time, s; each further time it takes twice as long."""
POLL = 0.5
"""Time between two looks at a lock that another process holds, s."""
NO_LOCKS = {errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP}
"""What file systems answer that cannot lock a file. Where they do not know the call, filelock takes soft locks."""


@contextmanager
def claimed(path: Path, timeout: float = 0.0) -> Iterator[bool]:
    """Whether the lock file at a path is this process's for the block; a process that ends in any way gives it back.

    Args:
        path: the lock file, which is there only while somebody holds it.
        timeout: how long to try, s.

    Raises:
        OSError: the file system has no locks.
    """
    lock: BaseFileLock = FileLock(path)
    try:
        lock.acquire(timeout=timeout)
    except Timeout:
        yield False
        return
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        raise OSError(
            error.errno, f"The file system of {path.parent} has no file locks. Choose another folder with $HNO_CACHE"
        ) from error
    try:
        if not isinstance(lock, SoftFileLock):  # which says so itself
            with suppress(OSError):  # a full disk
                path.write_text(f"{os.getpid()}\n{platform.node()}\n")
        yield True
    finally:
        with suppress(OSError):  # Windows keeps open files
            path.unlink()
        lock.release()


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Wait for a lock file, and hold it for the block. Raises as `claimed`."""
    waiting = Waiting()
    while True:
        with claimed(path, POLL) as ours:
            if ours:
                yield
                return
        waiting.announce(path)


class Waiting:
    """Says which lock this process waits for, at growing intervals."""

    def __init__(self) -> None:
        self.began, self.patience = time.monotonic(), PATIENCE

    def announce(self, path: Path) -> None:
        """Name the lock file and its holder, if it is time to."""
        if time.monotonic() - self.began >= self.patience:
            self.patience *= 2
            log.warning("Waiting for %s, held by %s.", path, holder(path))


def held(path: Path) -> bool:
    """Whether some process holds a lock file; also where it cannot be told, for want of locks or permissions."""
    if not path.exists():
        return False
    try:
        with claimed(path) as ours:
            return not ours
    except OSError:
        return True


def holder(path: Path) -> str:
    """Who holds a lock file."""
    try:
        since = datetime.fromtimestamp(path.stat().st_mtime).astimezone()
        process, host, *_ = path.read_text().splitlines()
    except (OSError, ValueError):  # it has just gone, or could not write its name
        return "another process"
    return f"process {process} on {host} since {since:%Y-%m-%d %H:%M:%S}"


def check_room(folder: Path, needed: float, what: str, remedy: str) -> None:
    """Refuse work whose files would not fit on a disk.

    Args:
        folder: where they go; it need not be there yet.
        needed: their size at least, bytes.
        what: they are.
        remedy: what to do besides freeing space.

    Raises:
        OSError: with both sizes.
    """
    there = next(place for place in (folder.absolute(), *folder.absolute().parents) if place.is_dir())
    free = shutil.disk_usage(there).free
    if free < needed:
        raise OSError(
            errno.ENOSPC,
            f"{what} need {needed / 1e6:,.1f} MB, but the disk of {there} has {free / 1e6:,.1f} MB free. "
            f"Free some space, or {remedy}",
        )
