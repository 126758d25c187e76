"""`hno labels`: open-loop equilibria from random start states, kept with their certificates."""

from __future__ import annotations

import functools
import sys
from collections.abc import Sequence
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from hno.cli.arguments import Arguments
from hno.cli.config import configured, read
from hno.cli.logs import label_progress, use_threads
from hno.cli.settings import LabelSettings
from hno.data.certificates import GLOBAL_GAP, LOCAL_GAP, summary
from hno.data.labels import Request, default_cache, label_set, labels_for
from hno.data.store import LabelFileError
from hno.games import Game, make
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
        print(f"Interrupted by {stop}. Finished shards are kept: the same command goes on from here.", file=sys.stderr)
        return stop.code
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
    console, report = Console(), label_progress(functools.partial(print, flush=True))
    found, seconds = labels_for(game, requests, cache, workers=settings.workers, report=report)
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
    for name in COLUMNS:
        table.add_column(name, justify="right")
    for request, row in zip(requests, rows, strict=True):
        worst = [row[f"largest_{name}"] for name in ("reintegration", "local_gap", "global_gap")]
        cells = [row["status"]["converged"], f"{row['inevitable'] / row['starts']:.1%}", row["safe"]]
        types = ", ".join(f"{t:g}" for t in request.theta)
        table.add_row(types, str(row["starts"]), *map(str, cells), *("-" if w is None else f"{w:.0e}" for w in worst))
    return table
