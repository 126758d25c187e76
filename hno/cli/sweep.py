"""What a multirun prints at its end: one line for every job."""

from __future__ import annotations

import json
import os
import platform
import shlex
import shutil
import signal
import tempfile
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from hno.cli import pages
from hno.cli.results import write_json
from hno.cli.tables import print_table, terminal
from hno.data.store import replace_whole
from hno.evaluation.format import NAMES, counted, interval, percent, signed, types
from hno.evaluation.outcome import pooled
from hno.report.runs import LOST, at_work

LOG, PREFIX, LEFT = "sweep.log", ".jobs-", "left"
"""Names in the folder of a sweep: its log, how that of a ledger begins, and what keeps a ledger there."""
TRIAL = "HNO_TRIAL"
"""Where a job of a search finds its number: launchers count those of one process."""
PAUSE = 20.0
"""Time between two pages of a sweep whose jobs fail one after the other, s."""
NAMED = (*NAMES, "seed")
"""Entries of results.json that name a job, in the order by which jobs are sorted."""
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
    how: str = ""
    """What a sweep that is run again did with it: "skipped", "resumed" or "repeated"."""
    refusal: str = ""
    """Why it was not run, whatever lies in its folder."""

    @classmethod
    def current(cls) -> Job:
        """The one that runs here."""
        hydra = HydraConfig.get()
        settings = tuple(setting.lstrip("+") for setting in hydra.overrides.task)
        number = hydra.job.env_set.get(TRIAL, 0 if OmegaConf.is_missing(hydra.job, "num") else hydra.job.num)
        return cls(int(number), Path(hydra.runtime.output_dir), settings)

    def results(self) -> dict[str, Any]:
        """Content of its results.json; without one that can be read, a failure; with one that has no end, lost."""
        try:
            found = dict(json.loads((self.folder / "results.json").read_text()))
        except (OSError, TypeError, ValueError) as error:
            return {"status": "failed", "reason": f"no results ({error})"}
        return found if at_work(self.folder, found) else {**found, **LOST}


class Entry(NamedTuple):
    """A job in the ledger."""

    job: Job
    succeeded: bool = False
    process: tuple[str, int] | None = None
    """Host and number of the process that does it, while it does."""

    @classmethod
    def begun(cls, job: Job) -> Entry:
        """Of a job that this process does."""
        return cls(job, process=(platform.node(), os.getpid()))

    @classmethod
    def read(cls, path: Path) -> Entry:
        """From its file."""
        content = json.loads(path.read_text())
        number, folder, settings, *rest = content.pop("job")
        return cls(Job(number, Path(folder), tuple(settings), *rest), **content)


class Ledger(NamedTuple):
    """Which jobs of a multirun began and which succeeded, in a folder that every process of the sweep can write.

    It also says which signal ended the sweep: jobs that have not begun then do not.
    """

    folder: Path
    sweep: Path
    """The folder of the sweep."""
    before: Path | None
    """The folder in which the sweep began, where it is run again."""
    cores: int | None
    """Of each job; None for all."""
    process: int
    """Of the sweep."""

    @classmethod
    @contextmanager
    def within(cls, sweep: Path, before: Path | None = None, cores: int | None = None) -> Iterator[Ledger]:
        """A new ledger in the folder of a sweep, which is gone afterwards, as are those that earlier sweeps left."""
        sweep.mkdir(parents=True, exist_ok=True)
        for old in sweep.glob(f"{PREFIX}*"):
            shutil.rmtree(old, ignore_errors=True)
        ledger = cls(Path(tempfile.mkdtemp(prefix=PREFIX, dir=sweep)), sweep, before, cores, os.getpid())
        try:
            yield ledger
        finally:
            if not (ledger.folder / LEFT).exists():
                shutil.rmtree(ledger.folder, ignore_errors=True)

    def leave(self) -> None:
        """Stay when the sweep ends, for jobs that go on without it."""
        (self.folder / LEFT).touch()

    def there(self, job: Job) -> Path | None:
        """The folder in which a job began before, or would have; None where the sweep is not run again."""
        return None if self.before is None else self.before / job.folder.relative_to(self.sweep)

    def knows(self, job: Job) -> bool:
        """Whether a job has begun."""
        return (self.folder / f"{job.number}.json").exists()

    def write(self, entry: Entry) -> None:
        """Add a job, or replace its entry."""
        number, folder, *rest = entry.job
        content = {"job": [number, str(folder), *rest], "succeeded": entry.succeeded, "process": entry.process}
        write_json(self.folder / f"{number}.json", content)

    def tell(self, job: Job) -> None:
        """Say at once what became of a job: in the sweep's log, and where it failed on its page too."""
        found, page = job.results(), self.sweep / pages.PAGE
        with (self.sweep / LOG).open("a", encoding="utf-8") as file:
            file.write(f"{datetime.now().astimezone():%Y-%m-%d %H:%M:%S} {outcome(job, found)}\n")
        late = not page.exists() or time.time() - page.stat().st_mtime > PAUSE
        if _status(job, found) in ("failed", "refused") and late:
            pages.write(self.sweep)

    def entries(self) -> list[Entry]:
        """Jobs that began, in their order."""
        return sorted(map(Entry.read, self.folder.glob("*.json")), key=lambda entry: entry.job.number)

    @property
    def signal(self) -> int | None:
        """The signal that ended the sweep; a ledger that is gone is one of a sweep that ended."""
        if not self.folder.is_dir():
            return int(signal.SIGTERM)
        mark = self.folder / "signal"
        return int(mark.read_text()) if mark.exists() else None

    def stop(self, number: int) -> None:
        """Begin no more jobs, because of a signal."""
        replace_whole(self.folder / "signal", lambda draft: draft.write_text(str(number)))

    def pass_on(self, number: int) -> bool:
        """Begin no more jobs, and send a signal to those that other processes of this machine do, if any do."""
        self.stop(number)
        told = [entry.process for entry in self.entries() if entry.process is not None]
        others = [process for host, process in told if host == platform.node() and process != os.getpid()]
        for process in others:
            with suppress(OSError):  # it has just ended
                os.kill(process, number)
        return bool(others)


def show_jobs(jobs: Sequence[Job], again: str | None = None) -> None:
    """Print a table over all jobs, why jobs failed, how to go on with what is not finished, and where their page lies.

    Args:
        jobs: that began.
        again: the command that goes on, if there is something to go on with.
    """
    shared = set[str].intersection(*(set(job.settings) for job in jobs))
    found = sorted(((job, job.results()) for job in jobs), key=_order)
    rows = [_cells(job, results, shared) for job, results in found]
    shown = [name for name in rows[0] if name != "settings" or any(row["settings"] for row in rows)]
    failures = [outcome(job, results) for job, results in found if job.refusal or results["status"] != "finished"]
    console = terminal()
    print_table(console, shown, [[row[name] for name in shown] for row in rows], counted(len(jobs), "job"), CAPTION)
    folder, in_haste = jobs[0].folder.parent, any(results["status"] == "interrupted" for _, results in found)
    page = f"Page: hno report {shlex.quote(str(folder))}" if in_haste else pages.write(folder)
    for line in (*failures, *([f"Run again what is not finished: {again}"] if again else []), page):
        console.print(line, soft_wrap=True, markup=False, highlight=False)


def outcome(job: Job, found: Mapping[str, Any]) -> str:
    """What became of a job, in one line."""
    status = _status(job, found)
    why = "" if status == "finished" else f": {' '.join(str(job.refusal or found['reason']).split())}"
    return f"Job {job.number} {status}{f', {job.how}' if job.how else ''}{why}"


def _status(job: Job, found: Mapping[str, Any]) -> str:
    """A job that was refused in a folder that has other results says so."""
    return "refused" if job.refusal and found["status"] != "failed" else str(found["status"])


def _order(entry: tuple[Job, Mapping[str, Any]]) -> tuple[Any, ...]:
    job, found = entry
    return *(str(found.get(name, "")) for name in NAMES), int(found.get("seed", 0)), job.number


def _cells(job: Job, found: Mapping[str, Any], shared: Collection[str]) -> dict[str, str]:
    """A job's line: its settings are those that not all jobs share and no other column shows."""
    whole, spent = pooled(found.get("table", ())), found.get("seconds", {}).values()
    own = [entry for entry in job.settings if entry not in shared and entry.partition("=")[0] not in NAMED]
    return {
        "job": str(job.number),
        **{name: str(found.get(name, "n/a")) for name in NAMED},
        "settings": " ".join(own),
        "collisions": f"{whole.collisions} of {whole.safe_starts}" if whole.safe_starts else "n/a",
        "95 % interval": interval(whole.interval),
        "worst type": percent(whole.worst_rate) + (f" at {types(whole.worst_theta)}" if whole.worst_theta else ""),
        "excess cost": signed(whole.relative_excess),
        "seconds": f"{sum(spent):.0f}" if spent else "n/a",
        "status": _status(job, found) + (f", {job.how}" if job.how else ""),
    }
