"""Runs of `hno train` and `hno evaluate` under Hydra: one, or every job of a multirun."""

from __future__ import annotations

import logging
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from lightning.fabric.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig

import hno
from hno.cli import pages
from hno.cli.arguments import Arguments
from hno.cli.config import configured, for_hydra, quoted, register_plugins, sentence, under_hydra
from hno.cli.logs import finish_wandb, send_lightning_to_hydra
from hno.cli.results import Results, recorded
from hno.cli.sections import show
from hno.cli.sweep import Job, show_jobs
from hno.evaluation.format import NAMES, counted
from hno.registry import UnknownNameError
from hno.training.checkpoint import CheckpointError

log = logging.getLogger(__name__)

REFUSALS = (HydraException, CheckpointError, ValueError, LookupError)
"""What a configuration raises that makes no run."""
QUIET = ("hydra/hydra_logging=disabled", "hydra/job_logging=disabled", "hydra.output_subdir=null")


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
    """
    many = "--multirun" in given.flags
    try:
        if not many and configured(task.name, task.check, given) is None:
            return 0  # a dry run
        return _jobs(task, given, many, dry=many and "--dry-run" in given.flags)
    except REFUSALS as error:
        message = sentence(error)
    except OSError as error:
        message = f"The output folder cannot be written ({error}). Choose another with --to <folder>."
    print(message, file=sys.stderr)
    return 1


def _jobs(task: Task, given: Arguments, many: bool, dry: bool) -> int:
    """Let Hydra run every job. A sweep ends with a table, also when it is interrupted; a dry one prints its jobs."""
    jobs: list[Job] = []
    outcomes: list[bool] = []

    def job(config: DictConfig) -> None:
        current = Job.current()
        jobs.append(current)
        if dry:
            print(f"{current.number}: {' '.join(current.settings)}")
        try:
            settings = task.check(config)
        except Exception as error:
            print(f"   refused: {error}") if dry else _refuse(current, error)
            outcomes.append(False)
        else:
            outcomes.append(dry or perform(task, settings, current.folder))

    words = [*(["--multirun"] if many else []), *for_hydra(task.name, given)]
    register_plugins()
    with tempfile.TemporaryDirectory() as nowhere:
        try:
            under_hydra(task.name, job, [*words, *QUIET, f"hydra.sweep.dir={quoted(nowhere)}"] if dry else words)
        finally:
            if many and jobs and not dry:
                show_jobs(jobs)
    if dry:
        refused = outcomes.count(False)
        print(counted(len(jobs), "job") + (f", {refused} refused" if refused else ""))
    if not many:
        print(pages.write(jobs[0].folder))
    return 0 if all(outcomes) else 1


def _refuse(job: Job, error: Exception) -> None:
    """Leave the reason in the results of a job that is not run: it is no failure of the jobs after it."""
    chosen = HydraConfig.get().runtime.choices
    results = Results(job.folder / "results.json", {group: chosen.get(group) for group in NAMES})
    results.update(status="failed", reason=str(error))
    log.error("%s", error, exc_info=None if isinstance(error, REFUSALS) else error)


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
