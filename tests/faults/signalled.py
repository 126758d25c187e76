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
from contextlib import contextmanager
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
    """Those that are alive half a second later."""


@contextmanager
def started(phase: str, mark: Path, cache: Path, *words: str) -> Iterator[subprocess.Popen[str]]:
    """A command whose phase has begun; whatever is left of it afterwards is killed."""
    name = uuid.uuid4().hex
    root = Path(__file__).parents[2]
    own = {VARIABLE: name, "HNO_CACHE": str(cache), "OMP_NUM_THREADS": "1", "PYTHONPATH": str(root)}
    command = subprocess.Popen(
        [sys.executable, "-m", "tests.faults.signalled", phase, str(mark), *words], env=os.environ | own,
        cwd=root, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, process_group=0,
    )  # fmt: skip
    try:
        while not (any(cache.rglob(".claim-*")) if phase == "labels" else mark.exists()):
            assert command.poll() is None, command.communicate()[0]
            time.sleep(0.02)
        yield command
    finally:
        for process in alive(name):
            os.kill(process, signal.SIGKILL)
        command.communicate()


def end(command: subprocess.Popen[str], number: int) -> Left:
    """Send a signal and wait for the end."""
    name = dict(entry.partition("=")[::2] for entry in Path(f"/proc/{command.pid}/environ").read_text().split("\0"))
    began = time.monotonic()
    command.send_signal(number)
    command.wait(60)
    seconds = time.monotonic() - began
    deadline = time.monotonic() + 3.0
    while (left := alive(name[VARIABLE])) and time.monotonic() < deadline:
        time.sleep(0.1)
    return Left(command.returncode, command.stdout.read() if command.stdout and not left else "", seconds, left)


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
