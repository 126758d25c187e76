"""Runs of `hno train` and `hno evaluate` under Hydra: one, or every job of a multirun."""

from __future__ import annotations

import logging
import sys
import tempfile
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hydra.core.hydra_config import HydraConfig
from lightning.fabric.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig

import hno
from hno.cli import pages
from hno.cli.arguments import Arguments, UsageError, one_screen, quoted
from hno.cli.config import REFUSALS, configured, for_hydra, register_plugins, sentence, under_hydra
from hno.cli.logs import finish_wandb, send_lightning_to_hydra
from hno.cli.results import Results, recorded
from hno.cli.schema import REGISTRIES
from hno.cli.sections import show
from hno.cli.sweep import Entry, Job, Ledger, show_jobs
from hno.evaluation.format import NAMES, counted
from hno.registry import UnknownNameError

log = logging.getLogger(__name__)

QUIET = ("hydra/hydra_logging=disabled", "hydra/job_logging=disabled", "hydra.output_subdir=null")


Parts = Mapping[str, Mapping[str, Any]]
"""Classes and functions by kind and name."""


class Task(NamedTuple):
    """What a command does in every job."""

    name: str
    """The root configuration."""
    check: Callable[[DictConfig], Any]
    """Judges a composed configuration before any work, and returns its settings."""
    head: Callable[[Any], dict[str, Any]]
    """What results.json says from the beginning, from the settings."""
    work: Callable[[Any, Results], None]
    """Does the job, from the settings."""


def run(task: Task, given: Arguments) -> int:
    """Check configurations and do a task on each, in every job of a multirun.

    The last line is the path of the page, which failed runs have too; a configuration that is refused leaves no folder,
    in a multirun its reason alone.

    Returns:
        The exit code: 1 if a job failed.

    Raises:
        UsageError: nothing was done, since the configuration makes no run.
    """
    if "--multirun" in given.flags:
        return _multirun(task, given)
    if configured(task.name, task.check, given) is None:
        return 0  # a dry run
    folders: list[Path] = []
    succeeded: list[bool] = []

    def job(config: DictConfig) -> None:
        folders.append(Path(HydraConfig.get().runtime.output_dir))
        succeeded.append(perform(task, task.check(config), folders[0]))

    register_plugins()
    try:
        under_hydra(task.name, job, for_hydra(task.name, given))
    except Exception as error:
        if folders:
            raise
        raise _refusal(error) from error
    print(pages.write(folders[0]))
    return 0 if all(succeeded) else 1


def _refusal(error: Exception) -> UsageError:
    """What Hydra raises before a job begins."""
    if isinstance(error, OSError):
        return UsageError(f"The output folder cannot be written ({error}). Choose another with --to <folder>.")
    return UsageError(sentence(error))


def _multirun(task: Task, given: Arguments) -> int:
    """Let Hydra's launcher run every job. It ends with a table, also when it is interrupted; a dry one prints its jobs.

    Launchers run jobs in processes of their own: what became of each is in a file of the ledger.
    """
    dry = "--dry-run" in given.flags
    try:
        words = for_hydra(task.name, given)
        register_plugins()
        with tempfile.TemporaryDirectory() as nowhere:
            folder = Path(nowhere if dry else HydraConfig.get().sweep.dir).absolute()
            words = [*_here(words), *QUIET] if dry else words
            return _swept(task, ["--multirun", *words, f"hydra.sweep.dir={quoted(str(folder))}"], folder, dry)
    except REFUSALS as error:
        raise _refusal(error) from error


def _here(words: Sequence[str]) -> list[str]:
    """Overrides without the launcher: a dry run stays in this process."""
    return [word for word in words if not word.lstrip("+").startswith(("hydra/launcher", "hydra.launcher"))]


def _swept(task: Task, words: Sequence[str], folder: Path, dry: bool) -> int:
    own = {kind: registry().own() for kind, registry in REGISTRIES.items()}
    failure = None
    with Ledger.within(folder) as ledger:

        def job(config: DictConfig) -> None:  # a launcher may send it to another process
            _job(task, config, ledger, own, dry)

        try:
            under_hydra(task.name, job, words)
        except Exception as error:
            if isinstance(error, REFUSALS) and not ledger.entries():
                raise
            failure = error
        finally:
            found = ledger.entries()
            if found and not dry:
                show_jobs([entry.job for entry in found])
    refused = sum(not entry.succeeded for entry in found)
    if dry:
        print(counted(len(found), "job") + (f", {refused} refused" if refused else ""))
    if failure is not None:
        print(f"The launcher ended before all jobs did: {one_screen(sentence(failure))}", file=sys.stderr)
    return 1 if refused or failure is not None else 0


def _job(task: Task, config: DictConfig, ledger: Ledger, own: Parts, dry: bool) -> None:
    """One job of a multirun, perhaps in another process, which is told what the user's own program registered."""
    for kind, parts in own.items():
        for name, part in parts.items():
            REGISTRIES[kind]().register(name)(part)
    current = Job.current()
    ledger.write(Entry(current))
    if dry:
        print(f"{current.number}: {' '.join(current.settings)}")
    try:
        settings = task.check(config)
    except Exception as error:
        print(f"   refused: {one_screen(sentence(error))}") if dry else _refuse(current, error)
    else:
        ledger.write(Entry(current, dry or perform(task, settings, current.folder)))


def _refuse(job: Job, error: Exception) -> None:
    """Leave the reason in the results of a job that is not run: it is no failure of the jobs after it."""
    chosen = HydraConfig.get().runtime.choices
    results = Results(job.folder / "results.json", {group: chosen.get(group) for group in NAMES})
    results.update(status="failed", reason=sentence(error))
    log.error("%s", one_screen(sentence(error)))


def perform(task: Task, settings: Any, folder: Path) -> bool:
    """Do one job; its folder gets results.json.

    Returns:
        Whether it succeeded. A failure has been logged and is in the results.
    """
    send_lightning_to_hydra()
    results = Results(folder / "results.json", task.head(settings))
    try:
        with recorded(results):
            task.work(settings, results)
    except Exception as error:
        _log(error)
        return False
    finally:
        finish_wandb(results.content)
    show(results.content, folder)
    return True


def _log(error: Exception) -> None:
    """Log what went wrong: one message for errors that were raised on purpose, a traceback for surprises."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = bool(frames) and Path(frames[-1].filename).is_relative_to(Path(hno.__file__).parent)
    meant = ours and isinstance(error, (ValueError, RuntimeError, UnknownNameError))
    expected = meant or isinstance(error, (OSError, MisconfigurationException))
    log.error("%s", error, exc_info=None if expected else error)
