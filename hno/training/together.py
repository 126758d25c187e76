"""Starts the other processes of a training, and ends them with it."""

from __future__ import annotations

import logging
import math
import os
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager

import torch
from joblib.externals.loky import ProcessPoolExecutor
from torch import distributed
from torch.distributed import TCPStore  # type: ignore[attr-defined]  # public, not in __all__
from torch.distributed.distributed_c10d import Store

from hno.processes import GRACE, Interrupted, break_off, interruptible, serve, stop_if_asked, waiting_signals
from hno.training.ranks import Ranks

log = logging.getLogger(__name__)

MOMENT = 2.0
"""Time in which the end of another rank is noticed, s."""
LONGEST = 60.0
"""Time after which this process ends, come what may, once another rank has failed, s."""
HOST, BEGUN, HERE = "127.0.0.1", "begun", "here"
Follow = Callable[[Ranks], object]
"""What the other ranks do."""


class RankError(RuntimeError):
    """Another process of the training failed."""


@contextmanager
def together(count: int, follow: Follow) -> Iterator[Ranks]:
    """Train in so many processes: this one is rank 0 in the block, the others follow it and end with it.

    Args:
        count: of processes.
        follow: what the others do; it is sent to them, with all that it knows.

    Raises:
        RankError: another one failed; what this has led to here is its cause.
    """
    if count == 1:
        yield Ranks()
        return
    others = _Others(count, follow)
    try:
        others.have(BEGUN)  # what is sent to them is changed from here on
        yield Ranks(0, count, others.meet)
    except BaseException as error:
        reason = others.reason(error)
        others.end(killed=True)
        if reason is not None:
            raise RankError(f"Another process of the training failed, and it ends with it. {reason}") from error
        raise
    others.end()


class _Others:
    """The other ranks, as rank 0 sees them."""

    def __init__(self, count: int, follow: Follow) -> None:
        self.count, self.failed, self.over = count, list[str](), threading.Event()
        self.store = TCPStore(HOST, 0, is_master=True, wait_for_workers=False)
        self.pool = ProcessPoolExecutor(count - 1, initializer=serve, initargs=(os.getpid(),))
        given = self.store.port, torch.get_num_threads(), follow
        self.running = [self.pool.submit(_rank, number, count, *given) for number in range(1, count)]
        for other in self.running:
            other.add_done_callback(self._ended)

    def meet(self) -> Store:
        """Wait until all are where they become one group."""
        self.have(HERE)
        return self.store

    def have(self, key: str) -> None:
        """Wait until all have said so."""
        while self.store.add(key, 0) < self.count - 1:
            stop_if_asked()
            if self.failed:
                raise RankError(self.failed[0])
            time.sleep(0.05)

    def reason(self, error: BaseException) -> str | None:
        """Why another one failed, if what happened here is due to it; what happens in all ranks is nobody's fault."""
        if not isinstance(error, Interrupted):
            wait(self.running, MOMENT, FIRST_COMPLETED)
        same = type(error) is not RuntimeError and self.failed[:1] and self.failed[0].startswith(type(error).__name__)
        return self.failed[0] if self.failed and not same else None

    def end(self, *, killed: bool = False) -> None:
        """Let them end; they have nothing to write."""
        self.over.set()
        _leave()
        self.pool.shutdown(kill_workers=killed)

    def _ended(self, other: Future[str | None]) -> None:
        """Note a failure. Whoever waits for that rank on a CPU is told so; on a GPU it would wait for ever."""
        error = other.exception()
        reason = other.result() if error is None else _said(error)
        if reason is not None and not self.over.is_set():
            self.failed.append(reason)
            threading.Thread(target=self._insist, daemon=True).start()

    def _insist(self) -> None:
        if not self.over.wait(GRACE):
            break_off()
        if not self.over.wait(LONGEST):
            log.error("Another process of the training failed, and this one cannot end: %s", self.failed[0])
            os._exit(1)


def _rank(number: int, count: int, port: int, threads: int, follow: Follow) -> str | None:
    """One of the other ranks, in its own process: what it has to say, rank 0 says.

    Returns:
        Why it failed.
    """
    logging.disable()
    warnings.simplefilter("ignore")
    torch.set_num_threads(threads)
    store = TCPStore(HOST, port, is_master=False)
    store.add(BEGUN, 1)

    def meet() -> Store:
        store.add(HERE, 1)
        return store

    try:
        with interruptible(), waiting_signals(math.inf):
            follow(Ranks(number, count, meet))
    except Interrupted as stop:
        return None if stop.between else _said(stop)
    except Exception as error:  # noqa: BLE001  # sent as text: not every error can be sent
        return _said(error)
    finally:
        _leave()
    return None


def _said(error: BaseException) -> str:
    """An error in words; of what cannot be sent to a process or read there, the last line of a traceback."""
    if error.__cause__ is not None:
        return str(error.__cause__).strip(' "\n').splitlines()[-1]
    return f"{type(error).__name__}: {error}"


def _leave() -> None:
    if distributed.is_initialized():
        distributed.destroy_process_group()
