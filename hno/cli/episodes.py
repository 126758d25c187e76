"""`hno episodes`: what a run's policy played, for other programs."""

from __future__ import annotations

from pathlib import Path

from hno.cli.arguments import Arguments, UsageError
from hno.registry import unknown_name

USAGE = "hno episodes RUN --to csv|commonroad|mcap [folder=FOLDER]"


def run(given: Arguments) -> int:
    """`hno episodes RUN --to csv|commonroad|mcap [folder=FOLDER]`."""
    from hno.report.trajectories import FORMATS, recorded

    others = [entry for entry in given.overrides if not entry.startswith("folder=")]
    if len(given.words) != 1 or others or "--to" not in given.flags:
        raise UsageError(f"Name one run and one format: {USAGE}")
    kind, source = given.flags["--to"], Path(given.words[0])
    if kind not in FORMATS:
        raise UsageError(unknown_name("format", kind, list(FORMATS)))
    if not source.is_dir():
        raise UsageError(f"{source} is not a folder. Give the folder of a run or of an evaluation.")
    chosen = [entry.partition("=")[2] for entry in given.overrides]
    folder = Path(chosen[-1]) if chosen else source / "episodes"
    found = recorded(source)
    if not found:
        raise ValueError(f"{source} keeps no episode: no start had a safe equilibrium.")
    try:
        files = FORMATS[kind](found, folder)
    except ModuleNotFoundError as error:
        raise OSError(f"Episodes as {kind} need the package {error.name}: pip install {error.name}") from error
    print(*files, sep="\n")
    return 0
