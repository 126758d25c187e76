"""A command that says when a part of its work begins, and what is left of it after a signal.

`python -m tests.faults.signalled PHASE MARK WORDS...` runs `hno WORDS...`; the file MARK is there once the phase began.
"""

from __future__ import annotations

import functools
import os
import pkgutil
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from hno.cli.main import main

PHASES = {
    "training": ("hno.training.module:TrainingModule", "training_step"),
    "validation": ("hno.training.validation:ClosedLoopValidation", "play"),
    "rounds": ("hno.training.adaptive:AdaptiveLabels", "_solved"),
    "evaluation": ("hno.cli.evaluate", "play"),
    "sections": ("hno.evaluation.residuals:Residuals", "compute"),
}
"""Functions in which a phase is; "labels" begin in another process, which leaves a claim in the cache."""
CALL = 3
"""Which call of a training step begins the phase: after a step or two."""
VARIABLE = "HNO_SIGNALLED"


def announce(phase: str, mark: Path) -> None:
    """Let the function of a phase leave a mark and take a while longer."""
    where, name = PHASES[phase]
    owner, calls = pkgutil.resolve_name(where), [0]
    original: Callable[..., Any] = getattr(owner, name)

    @functools.wraps(original)
    def slow(*arguments: Any, **options: Any) -> Any:
        calls[0] += 1
        if phase != "training" or calls[0] == CALL:
            mark.touch()
            time.sleep(2.0)
        return original(*arguments, **options)

    setattr(owner, name, slow)


class Left(NamedTuple):
    """What became of a command."""

    code: int
    text: str
    seconds: float
    """From the signal to the end."""
    processes: list[int]
    """Those that are alive some seconds later."""


class Started(NamedTuple):
    """A command at work."""

    process: subprocess.Popen[bytes]
    name: str
    """Which its processes have in their environment."""
    output: Path

    def until(self, begun: Callable[[], bool]) -> None:
        """Wait for a part of the work to begin."""
        while not begun():
            assert self.process.poll() is None, self.output.read_text()
            time.sleep(0.02)

    def end(self, number: int, patience: float = 3.0) -> Left:
        """Send a signal and wait for the end, and for that of its processes for some seconds more."""
        began = time.monotonic()
        self.process.send_signal(number)
        self.process.wait(60)
        seconds = time.monotonic() - began
        deadline = time.monotonic() + patience
        while (left := alive(self.name)) and time.monotonic() < deadline:
            time.sleep(0.1)
        return Left(self.process.returncode, self.output.read_text(), seconds, left)


@contextmanager
def started(phase: str, folder: Path, cache: Path, *words: str) -> Iterator[Started]:
    """A command, whose phase leaves a file "mark" in a folder; whatever is left of it afterwards is killed."""
    folder.mkdir(exist_ok=True)
    root, name, output = Path(__file__).parents[2], uuid.uuid4().hex, folder / "output"
    own = {VARIABLE: name, "HNO_CACHE": str(cache), "OMP_NUM_THREADS": "1", "PYTHONPATH": str(root)}
    with output.open("wb") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.faults.signalled", phase, str(folder / "mark"), *words],
            env=os.environ | own, cwd=root, stdout=file, stderr=subprocess.STDOUT, process_group=0,
        )  # fmt: skip
    try:
        yield Started(process, name, output)
    finally:
        for left in alive(name):
            with suppress(ProcessLookupError):
                os.kill(left, signal.SIGKILL)
        process.wait()


def alive(name: str) -> list[int]:
    """Processes that belong to a command, but for those that are dead and not yet buried."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            ours = f"{VARIABLE}={name}".encode() in (folder / "environ").read_bytes().split(b"\0")
            if ours and (folder / "stat").read_text().rpartition(")")[2].split()[0] != "Z":
                found.append(int(folder.name))
        except OSError:
            continue
    return found


if __name__ == "__main__":
    _, chosen, place, *rest = sys.argv
    if chosen in PHASES:
        announce(chosen, Path(place))
    sys.exit(main(rest))
