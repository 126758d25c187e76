"""`hno labels`: open-loop equilibria from random start states, kept with their certificates."""

from __future__ import annotations

import functools
import sys
from collections.abc import Sequence
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from hno.cli.arguments import Arguments
from hno.cli.config import configured, read
from hno.cli.logs import use_threads
from hno.cli.progress import label_progress
from hno.cli.settings import LabelSettings
from hno.cli.tables import print_table, terminal
from hno.data.certificates import GLOBAL_GAP, LOCAL_GAP, summary
from hno.data.labels import Request, default_cache, label_set, labels_for
from hno.data.store import LabelFileError
from hno.games import make
from hno.games.grid import parse_types
from hno.processes import Interrupted
from hno.types import Status

COLUMNS = (
    "theta", "starts", "converged", "inevitable collisions", "safe", "re-integration", "local gap", "global gap",
)  # fmt: skip


def run(given: Arguments) -> int:
    """`hno labels`; the exit code is 0 only if every set is complete."""
    use_threads(1)
    settings = configured("labels", check, given)
    try:
        if settings is not None:
            generate(settings)
    except (BrokenProcessPool, LabelFileError) as error:
        killed = "A worker process was killed, mostly for lack of memory. Finished shards are kept: try fewer workers."
        print(killed if isinstance(error, BrokenProcessPool) else error, file=sys.stderr)
        return 1
    except Interrupted as stop:
        stop.add_note("Finished shards are kept: the same command goes on from here")
        raise
    return 0


def check(config: DictConfig) -> LabelSettings:
    """The settings of labels that can be solved.

    Raises:
        ValueError, LookupError: entries that are unknown or make no sense, together or for the game.
    """
    settings = read(LabelSettings, config)
    parse_types(make(settings.game.name, **settings.game.constants), settings.theta, key="theta")
    return settings


def generate(settings: LabelSettings) -> None:
    """Generate, and print a table and where the sets are."""
    game, cache = make(settings.game.name, **settings.game.constants), Path(settings.cache or default_cache())
    every = settings.all_equilibria
    if every is None:
        every = game.potential and settings.split == "train"
    requests = [
        Request(theta, settings.n, settings.seed, settings.split, settings.widen, all_equilibria=every)
        for theta in parse_types(game, settings.theta, key="theta")
    ]
    console = terminal()
    with label_progress(say=functools.partial(print, flush=True)) as report:
        found, seconds = labels_for(game, requests, cache, workers=settings.workers, report=report)
    rows = [summary(labels) for labels in found]
    title = f"{type(game).__name__}, split {settings.split}, seed {settings.seed}"
    print_table(console, COLUMNS, [_cells(*entry) for entry in zip(requests, rows, strict=True)], title)
    console.print(_total(rows), highlight=False)
    for status in Status:
        count = sum(row["status"][status.name.lower()] for row in rows)
        if count and status != Status.CONVERGED:
            console.print(f"{count} {status.name.lower()}: {status.advice}.", highlight=False)
    console.print(f"{seconds:.0f} s. Label sets:", highlight=False)
    for request in requests:
        print(label_set(game, request, cache).folder)


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


def _cells(request: Request, row: dict[str, Any]) -> list[str]:
    worst = [row[f"largest_{name}"] for name in ("reintegration", "local_gap", "global_gap")]
    counts = row["starts"], row["status"]["converged"], f"{row['inevitable'] / row['starts']:.1%}", row["safe"]
    types = ", ".join(f"{t:g}" for t in request.theta)
    return [types, *map(str, counts), *("-" if w is None else f"{w:.0e}" for w in worst)]
