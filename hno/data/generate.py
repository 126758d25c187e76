"""Label sets from the command line: `python -m hno.data.generate game=<name> theta=<types> n=<starts per type>`."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from yaml import YAMLError  # type: ignore[import-untyped]  # yaml has no annotations

from hno.data import labels as label_data
from hno.data.certificates import GLOBAL_GAP, LOCAL_GAP, summary
from hno.data.labels import Report, Request, default_cache, label_set, labels_for
from hno.data.store import LabelFileError
from hno.games import Game, make
from hno.games.grid import parse_types
from hno.types import Status

USAGE = """Solve open-loop equilibria from random start states and keep them, with their certificates.

    python -m hno.data.generate game=narrow_road theta=grid5 n=1000

game       name of a registered game
theta      player types: grid5, grid9, or a list such as "1,1;2.5,4"
n          start states per type; more of them extend a set that is there
seed       of the start states (0)
split      what they are for: train, or test for evaluations (train)
widen      width of the start box in units of the game's (1)
constants  of the game, such as constants.radius=1.3
workers    processes with one thread each (the number of cores)
cache      folder of the label sets ($HNO_CACHE, or the user's cache folder)

A run that was stopped goes on where it was. Several runs may share one folder."""

DEFAULTS: dict[str, Any] = {
    "game": "???",
    "theta": "???",
    "n": "???",
    "seed": 0,
    "split": "train",
    "widen": 1.0,
    "constants": {},
    "workers": None,
    "cache": None,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit code is 0 only if every set is complete."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or {"-h", "--help", "help"} & set(given):
        print(USAGE)
        return 0 if given else 2
    try:
        run(read_options(given))
    except (OSError, LookupError, ValueError, TypeError, LabelFileError, OmegaConfBaseException) as error:
        text = error.args[0] if isinstance(error, KeyError) and error.args else error
        print(f"{type(error).__name__}: {text}", file=sys.stderr)
        return 1
    except BrokenProcessPool:
        text = "A worker process was killed, mostly for lack of memory. Finished shards are kept: try fewer workers."
        print(text, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("Stopped. Finished shards are kept: the same command goes on from here.", file=sys.stderr)
        return 130
    return 0


def read_options(given: Sequence[str]) -> DictConfig:
    """Options from `name=value` words.

    Raises:
        ValueError: an unknown or missing option, or a value that makes no sense.
    """
    wrong = [word for word in given if "=" not in word]
    try:
        options = OmegaConf.from_cli([word for word in given if "=" in word])
    except YAMLError as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"The options {' '.join(given)} cannot be read: {reason}.") from error
    wrong += [str(name) for name in options if name not in DEFAULTS]
    merged = OmegaConf.merge(DEFAULTS, options)
    assert isinstance(merged, DictConfig)
    missing = [name for name in DEFAULTS if OmegaConf.is_missing(merged, name)]
    if wrong or missing:
        what = f"Unknown: {', '.join(wrong)}." if wrong else f"Missing: {', '.join(missing)}."
        raise ValueError(f"{what} Options are written as name=value: {', '.join(DEFAULTS)}.")
    for name, least in (("n", 1), ("seed", 0), ("workers", 1)):
        value = merged[name]
        if not (type(value) is int and value >= least) and not (name == "workers" and value is None):
            raise ValueError(f"{name} must be a whole number of at least {least}; got {value!r}.")
    if merged.split not in ("train", "test"):
        raise ValueError(f"split must be train or test; got {merged.split!r}.")
    if not (type(merged.widen) in (int, float) and 0 < merged.widen < float("inf")):
        raise ValueError(f"widen must be a positive number; got {merged.widen!r}.")
    if not isinstance(merged.constants, DictConfig):
        raise ValueError(f"constants are written one by one, constants.<name>=<value>; got {merged.constants!r}.")
    return merged


def run(options: DictConfig) -> None:
    """Generate, and print a table and where the sets are."""
    game = make(str(options.game), **{str(name): value for name, value in options.constants.items()})
    cache = default_cache() if options.cache is None else Path(str(options.cache))
    requests = [
        Request(theta, options.n, options.seed, options.split, float(options.widen))
        for theta in parse_types(game, str(options.theta))
    ]
    console = Console()
    with progress_report(console) as report:
        found, seconds = labels_for(game, requests, cache, workers=options.workers, report=report)
    rows = [summary(labels) for labels in found]
    console.print(_table(game, requests, rows))
    console.print(_total(rows), highlight=False)
    for status in Status:
        count = sum(row["status"][status.name.lower()] for row in rows)
        if count and status != Status.CONVERGED:
            console.print(f"{count} {status.name.lower()}: {status.advice}.", highlight=False)
    console.print(f"{seconds:.0f} s. Label sets:", highlight=False)
    for request in requests:
        print(label_set(game, request, cache).folder)


@contextmanager
def progress_report(console: Console, every: float = 10.0) -> Iterator[Report]:
    """A live bar on a terminal, elsewhere a line every so many seconds."""
    columns = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    began = last = time.monotonic()
    with Progress(*columns, TimeRemainingColumn(), console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("solving", total=None)

        def say(now: label_data.Progress) -> None:
            nonlocal last
            clock = time.monotonic()
            rate = now.done / max(clock - began, 1e-9)
            text = f"{now.converged} converged, {now.done - now.converged} failed, {rate:.1f}/s"
            bar.update(task, completed=now.done, total=now.total, description=text)
            if not console.is_terminal and (clock - last >= every or now.done == now.total):
                last = clock
                left = (now.total - now.done) / rate
                print(f"{now.done} of {now.total}: {text}, {left:.0f} s left", flush=True)

        yield say


def _total(rows: Sequence[dict[str, Any]]) -> str:
    """One sentence over all types."""
    starts, local, wide = (sum(row[name] for row in rows) for name in ("starts", "above_local_gap", "above_global_gap"))
    converged = sum(row["status"]["converged"] for row in rows)
    least = min(row["status"]["converged"] / row["starts"] for row in rows)
    return (
        f"{converged:,} of {starts:,} converged ({converged / starts:.2%}, at least {least:.1%} at a type). "
        f"Best-response gap above {LOCAL_GAP:g} from the equilibrium itself: {local}; "
        f"above {GLOBAL_GAP:g} from several starts: {wide}."
    )


def _table(game: Game, requests: Sequence[Request], rows: Sequence[dict[str, Any]]) -> Table:
    table = Table(title=f"{type(game).__name__}, split {requests[0].split}, seed {requests[0].seed}")
    columns = (
        "theta",
        "starts",
        "converged",
        "inevitable collisions",
        "safe",
        "re-integration",
        "local gap",
        "global gap",
    )
    for name in columns:
        table.add_column(name, justify="right")
    for request, row in zip(requests, rows, strict=True):
        worst = [row[f"largest_{name}"] for name in ("reintegration", "local_gap", "global_gap")]
        cells = [row["status"]["converged"], f"{row['inevitable'] / row['starts']:.1%}", row["safe"]]
        types = ", ".join(f"{t:g}" for t in request.theta)
        table.add_row(types, str(row["starts"]), *map(str, cells), *("-" if w is None else f"{w:.0e}" for w in worst))
    return table


if __name__ == "__main__":
    torch.set_num_threads(1)
    raise SystemExit(main())
