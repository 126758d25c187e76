"""`hno labels`: open-loop equilibria from random start states, kept with their certificates."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from hno.cli.arguments import Arguments
from hno.cli.build import build_game
from hno.cli.config import configured
from hno.cli.logs import use_threads
from hno.cli.schema import LabelSettings
from hno.cli.starts import cache_folder
from hno.data import labels as label_data
from hno.data.certificates import GLOBAL_GAP, LOCAL_GAP, summary
from hno.data.labels import Report, Request, label_set, labels_for
from hno.data.store import LabelFileError
from hno.games import Game
from hno.games.grid import parse_types
from hno.types import Status


def run(given: Arguments) -> int:
    """`hno labels`; the exit code is 0 only if every set is complete."""
    use_threads(1)
    try:
        settings = configured("labels", LabelSettings, given)
        if settings is not None:
            generate(settings)
    except BrokenProcessPool:
        text = "A worker process was killed, mostly for lack of memory. Finished shards are kept: try fewer workers."
        print(text, file=sys.stderr)
        return 1
    except (OSError, LookupError, ValueError, LabelFileError) as error:
        print(error, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("Stopped. Finished shards are kept: the same command goes on from here.", file=sys.stderr)
        return 130
    return 0


def generate(settings: LabelSettings) -> None:
    """Generate, and print a table and where the sets are."""
    game, cache = build_game(settings.game), cache_folder(settings.cache)
    requests = [
        Request(theta, settings.n, settings.seed, settings.split, float(settings.widen))
        for theta in parse_types(game, settings.theta, key="theta")
    ]
    console = Console()
    with progress_report(console) as report:
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
