"""What a terminal shows of work under way: named bars with the time left, short messages, and where a signal came."""

from __future__ import annotations

import logging
import math
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import lightning as L
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from hno.data.labels import Progress as LabelProgress
from hno.data.labels import Report
from hno.processes import Interrupted

log = logging.getLogger(__name__)
FILE_ONLY = {"file_only": True}
"""`extra` of messages that a bar says as well."""
EVERY = 10.0
"""Time between two lines of one piece of work, where there is no bar, s."""
Update = Callable[..., None]
"""Says how far work is: (done, total, note="")."""

_bars = Progress(
    TextColumn("{task.description}"), BarColumn(20), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"),
    TimeRemainingColumn(compact=True), TextColumn("{task.fields[note]}"), console=Console(), transient=True,
)  # fmt: skip
"""All bars of the process: a terminal shows one display at a time."""


@contextmanager
def progress(name: str, say: Callable[..., None] | None = log.info) -> Iterator[Update]:
    """A named piece of work: a bar on a terminal, elsewhere a line every `EVERY` seconds.

    Args:
        name: of the work; where a signal ends it, the message has it.
        say: takes the lines; None for work that has lines of its own.

    Yields:
        What is to be told how far it is.
    """
    seen, last, began, shown = [0, 0], time.monotonic(), time.monotonic(), sys.stdout.isatty()
    task = _bars.add_task(name, total=None, note="") if shown else None

    def update(done: int, total: int, note: str = "") -> None:
        nonlocal last
        seen[:] = done, total
        if task is not None:
            _bars.update(task, completed=done, total=total, note=note)
        now = time.monotonic()
        if say is not None and total and (done in (0, total) or now - last >= EVERY):
            last, left = now, (total - done) * (now - began) / max(done, 1)
            rest = f", {left:.0f} s left" if 0 < done < total else ""
            options = {"extra": FILE_ONLY} if task is not None and done < total and say == log.info else {}
            say(f"{name}: {done} of {total}{f': {note}' if note else ''}{rest}", **options)

    try:
        if task is not None:
            _bars.start()
        yield update
    except Interrupted as stop:
        stop.add_note(f"In {name}" + (f", {seen[0]} of {seen[1]} done" if seen[1] else ""))
        raise
    finally:
        if task is not None:
            _bars.remove_task(task)
            if not _bars.tasks:
                _bars.stop()


@contextmanager
def label_progress(name: str = "labels", say: Callable[..., None] = log.info) -> Iterator[Report]:
    """A function that is told how many labels are solved, and shows it under a name."""
    with progress(name, say) as update:

        def report(found: LabelProgress) -> None:
            note = f"{found.converged} converged, {found.done - found.converged} failed" if found.done else ""
            update(found.done, found.total, note)

        yield report


class StepLines(L.Callback):
    """One line in the log every so many steps, and the bar of the training.

    Args:
        every: steps between lines.
        update: the bar's.
    """

    def __init__(self, every: int, update: Update = lambda *arguments: None) -> None:
        self.every, self.update = every, update

    def on_train_batch_end(self, trainer: L.Trainer, *others: Any) -> None:
        """Say the losses; on a terminal the bar does."""
        step, last = trainer.global_step, trainer.max_steps
        self.update(step, last, f"loss {float(trainer.callback_metrics.get('loss/total', math.nan)):.3g}")
        if step % self.every == 0:
            found = [(name, float(value)) for name, value in sorted(trainer.callback_metrics.items())]
            losses = ", ".join(f"{k} {v:.4g}" for k, v in found if k == "loss/total" or not math.isnan(v))
            log.info("step %d of %d: %s", step, last, losses, extra=FILE_ONLY if sys.stdout.isatty() else None)


class Terse(logging.Handler):
    """Messages on a terminal: the time and what is said, above the bars if there are any."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print, but for what a bar says."""
        if not getattr(record, "file_only", False):
            level = f" {record.levelname.capitalize()}:" if record.levelno > logging.INFO else ""
            print(
                f"{time.strftime('%H:%M:%S', time.localtime(record.created))}{level} {self.format(record)}", flush=True
            )


def collect_messages() -> None:
    """Let messages of Lightning and Python's warnings reach Hydra's handlers; on a terminal they are short there."""
    logging.captureWarnings(True)
    warnings.formatwarning = lambda message, category, *_, **__: f"{category.__name__}: {message}"
    for name in ("lightning", "lightning.pytorch", "lightning.fabric"):
        logger = logging.getLogger(name)
        logger.handlers.clear()
        logger.propagate = True
    root = logging.getLogger()
    if sys.stdout.isatty():
        root.handlers[:] = [Terse() if type(one) is logging.StreamHandler else one for one in root.handlers]
