"""What a multirun prints at its end: one line for every job."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hydra.core.hydra_config import HydraConfig
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from hno.cli import pages
from hno.evaluation.format import interval, percent, signed, types
from hno.evaluation.outcome import pooled

NAMES = ("game", "operator", "activation", "seed")
"""Entries of results.json that name a job, in the order by which jobs are sorted."""
COLUMNS = ("collisions", "95 % interval", "worst type", "excess cost", "seconds", "status")
WRAPPED = ("settings", "95 % interval", "worst type")
"""Columns that take several lines where the terminal is narrow."""
WIDTH = 160
"""Columns of text where there is no terminal to ask."""
CAPTION = (
    "collisions of safe starts over all types; excess cost: above the equilibrium's joint cost, the median over starts "
    "and types"
)


class Job(NamedTuple):
    """A job of a multirun."""

    number: int
    folder: Path
    settings: tuple[str, ...]
    """What the command line chose for it."""

    @classmethod
    def current(cls) -> Job:
        """The one that runs here."""
        hydra = HydraConfig.get()
        settings = tuple(setting.lstrip("+") for setting in hydra.overrides.task)
        return cls(hydra.job.num, Path(hydra.runtime.output_dir), settings)

    def results(self) -> dict[str, Any]:
        """Content of its results.json; without one that can be read, a failure that says so."""
        try:
            return dict(json.loads((self.folder / "results.json").read_text()))
        except (OSError, TypeError, ValueError) as error:
            return {"status": "failed", "reason": f"no results ({error})"}


def counted(jobs: int) -> str:
    """A number of jobs."""
    return f"{jobs} job" if jobs == 1 else f"{jobs} jobs"


def show_jobs(jobs: Sequence[Job]) -> None:
    """Print a table over all jobs, why jobs failed, and where their page lies."""
    chosen = _differences(jobs)
    rows = [(job, found, chosen[job.number]) for job, found in sorted(((j, j.results()) for j in jobs), key=_order)]
    extra = ("settings",) if any(chosen.values()) else ()
    table = Table(title=counted(len(jobs)), caption=CAPTION, box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for name in ("job", *NAMES, *extra, *COLUMNS):
        table.add_column(name, no_wrap=name not in WRAPPED)
    for job, found, settings in rows:
        table.add_row(str(job.number), *_names(found), *([settings] if extra else []), *_cells(found))
    console = Console(width=None if sys.stdout.isatty() else WIDTH)
    console.print(table)
    for job, found, _ in rows:
        if found["status"] != "finished":
            reason = " ".join(str(found["reason"]).split())
            console.print(
                f"Job {job.number} {found['status']}: {reason}", soft_wrap=True, markup=False, highlight=False
            )
    console.print(pages.write(jobs[0].folder.parent), soft_wrap=True, markup=False, highlight=False)


def _order(entry: tuple[Job, Mapping[str, Any]]) -> tuple[str, str, str, int, int]:
    job, found = entry
    game, operator, activation = (str(found.get(name, "")) for name in NAMES[:3])
    return game, operator, activation, int(found.get("seed", 0)), job.number


def _differences(jobs: Sequence[Job]) -> dict[int, str]:
    """Settings of every job that not all jobs share and no other column shows."""
    shared = set[str].intersection(*(set(job.settings) for job in jobs))
    shown = tuple(f"{name}=" for name in NAMES)
    return {
        job.number: " ".join(s for s in job.settings if s not in shared and not s.startswith(shown)) for job in jobs
    }


def _names(found: Mapping[str, Any]) -> list[str]:
    return [str(found.get(name, "n/a")) for name in NAMES]


def _cells(found: Mapping[str, Any]) -> list[str]:
    whole = pooled(found.get("table", ()))
    spent = found.get("seconds", {}).values()
    at = f" at {types(whole.worst_theta)}" if whole.worst_theta else ""
    return [
        f"{whole.collisions} of {whole.safe_starts}" if whole.safe_starts else "n/a",
        interval(whole.interval),
        percent(whole.worst_rate) + at,
        signed(whole.relative_excess),
        f"{sum(spent):.0f}" if spent else "n/a",
        str(found["status"]),
    ]
