"""`hno export`: a trained controller as NumPy, C, ONNX or a torch program."""

from __future__ import annotations

from pathlib import Path

from hno.cli.arguments import Arguments, UsageError
from hno.cli.logs import use_threads

USAGE = "hno export RUN|CHECKPOINT --to numpy|c|onnx|torch [folder=FOLDER]"


def run(given: Arguments) -> int:
    """`hno export RUN|CHECKPOINT --to KIND [folder=FOLDER]`."""
    words = dict(entry.split("=", 1) for entry in given.overrides if entry.startswith("folder="))
    paths = [*given.words, *(entry for entry in given.overrides if not entry.startswith("folder="))]
    if len(paths) != 1 or "--to" not in given.flags:
        raise UsageError(f"Name one run or checkpoint and what it is exported to. Usage: {USAGE}")
    from hno.export import KINDS, ExportError, UnsupportedError
    from hno.runtime import ArtefactError
    from hno.training.checkpoint import CheckpointError, find_checkpoint, load_policy

    kind = given.flags["--to"]
    if kind not in KINDS:
        raise UsageError(f"--to is one of {', '.join(KINDS)}; got {kind!r}.")
    use_threads(1)
    try:
        checkpoint = find_checkpoint(paths[0])
        folder = Path(words.get("folder", checkpoint.parent / "exported" / kind))
        print(load_policy(checkpoint).export(kind, folder))
    except (ArtefactError, CheckpointError, ExportError, UnsupportedError) as error:
        raise OSError(str(error)) from error
    return 0
