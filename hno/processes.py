"""How processes end: a signal becomes an exception where nothing is half done, and workers go with their parent."""

from __future__ import annotations

import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

NAMES = "SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1", "SIGUSR2"
SIGNALS = [getattr(signal, name) for name in NAMES if hasattr(signal, name)]
"""Those that ask a process to end.

Slurm sends SIGTERM, or what it is told to, before it takes a node back: submitit tells it SIGUSR2.
"""
GRACE = 5.0
"""Time that a step under way has to come to its end, s."""
SAME = 1.0
"""Time in which several signals are one, s: of a terminal and of a parent, say."""


class Interrupted(BaseException):
    """A signal asks this process to end; no `KeyboardInterrupt`, of which libraries make what they like.

    Args:
        number: of the signal.
        between: whether it was waited with until nothing was half done.
    """

    def __init__(self, number: int, between: bool = False) -> None:
        super().__init__(number, between)
        self.number, self.between = number, between

    def __str__(self) -> str:
        """The signal's name."""
        return signal.Signals(self.number).name

    @property
    def code(self) -> int:
        """The exit code that shells give to a process that a signal ended."""
        return 128 + self.number


class _State:
    """What this process was asked, and how it answers."""

    number: int | None = None
    """The first signal."""
    since = 0.0
    """When it came, s."""
    taken = False
    """Whether signals are this module's."""
    waits: float | None = None
    """How long it waits for `stop_if_asked`, s; None if it does not."""
    follows: int | None = None
    """The parent that it ends with."""
    tell: Callable[[int], bool] | None = None
    """Passes a signal on to other processes; whether any of them is to end first."""


def _answer(number: int, frame: FrameType | None) -> None:
    again = _State.number is not None
    if again and time.monotonic() - _State.since < SAME:
        return
    if not again:
        _State.number, _State.since = number, time.monotonic()
        if _State.waits is not None:
            signal.setitimer(signal.ITIMER_REAL, 0 if _State.waits == math.inf else _State.waits)
            return
        if _State.tell is not None and _State.tell(number):
            return
    raise Interrupted(_State.number or number)


def _lose_patience(number: int, frame: FrameType | None) -> None:
    raise Interrupted(_State.number or number)


def stop_if_asked(agreed: Callable[[int], int] | None = None) -> None:
    """Raise `Interrupted` if a signal came; called where nothing is half done.

    Args:
        agreed: what several processes make of the number of each one's signal, 0 for none.
    """
    own = _State.number or 0
    if number := own if agreed is None else agreed(own):
        signal.setitimer(signal.ITIMER_REAL, 0)
        raise Interrupted(number, between=True)


@contextmanager
def interruptible() -> Iterator[None]:
    """Let signals raise `Interrupted` in a block of the main thread.

    Those that are ignored stay so (under nohup, or in the background of a script).
    """
    if _State.taken or threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [*SIGNALS, signal.SIGALRM]
    before = {number: signal.getsignal(number) for number in numbers}
    _State.number = None
    _State.taken = True
    _take_signals()
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        _State.number, _State.taken = None, False
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


@contextmanager
def interruptible_call() -> Iterator[None]:
    """As `interruptible`, in a program of somebody else: it ends in KeyboardInterrupt, or in SystemExit by others."""
    try:
        with interruptible():
            yield
    except Interrupted as stop:
        if _State.taken:
            raise
        raise KeyboardInterrupt if stop.number == signal.SIGINT else SystemExit(stop.code) from stop


def take_back_signals() -> None:
    """Take signals from a library that put itself before this module, inside `interruptible`."""
    if _State.taken:
        _take_signals()


def _take_signals() -> None:
    for number in SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _answer)
    signal.signal(signal.SIGALRM, _lose_patience)


@contextmanager
def waiting_signals(longest: float = GRACE) -> Iterator[None]:
    """Let a signal wait for the next `stop_if_asked`, for so long at most, s."""
    _State.waits = longest
    try:
        yield
    finally:
        _State.waits = None


def break_off() -> None:
    """Let `Interrupted` be raised in the main thread, if signals are this module's; called from another thread."""
    if _State.taken:
        os.kill(os.getpid(), signal.SIGALRM)


@contextmanager
def passed_on(tell: Callable[[int], bool]) -> Iterator[None]:
    """Pass a signal on; where another process is to end first, this one waits for it, until a second signal.

    Args:
        tell: passes it on, and says whether any process took it.
    """
    _State.tell = tell
    try:
        yield
    finally:
        _State.tell = None


def serve(parent: int) -> None:
    """Begin a worker process: signals are its parent's matter, but for SIGTERM, and it ends when its parent is gone.

    Args:
        parent: its process id.
    """
    for number in SIGNALS:
        if number != signal.SIGTERM:
            signal.signal(number, signal.SIG_IGN)
    _watch(parent, lambda: os._exit(1))


def follow(parent: int) -> None:
    """End this process as SIGTERM does, in good order, when the process that started it is gone; said once is enough.

    Args:
        parent: the id of the process that work is done for; nothing happens where another one started this.
    """
    if os.getppid() == parent and _State.follows is None:
        _State.follows = parent

        def orphaned() -> None:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(2 * GRACE)
            os._exit(1)  # workers of a pool would wait for more to do

        _watch(parent, orphaned)


def forsaken() -> bool:
    """Whether this process follows one that is gone."""
    return _State.follows not in (None, os.getppid())


def _watch(parent: int, orphaned: Callable[[], None]) -> None:
    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        orphaned()

    threading.Thread(target=watch, daemon=True).start()
