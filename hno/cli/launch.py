"""Runs of `hno train` and `hno evaluate` under Hydra: one, or every job of a multirun."""

from __future__ import annotations

import logging
import os
import shlex
import sys
import tempfile
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

from hydra.core.hydra_config import HydraConfig
from lightning.fabric.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig, OmegaConf

import hno
from hno.cli import pages
from hno.cli.arguments import Arguments, UsageError, one_screen, quoted
from hno.cli.config import REFUSALS, configured, for_hydra, groups, register_plugins, sentence, under_hydra
from hno.cli.logs import finish_wandb, refuse_wandb
from hno.cli.objective import Objective, objective
from hno.cli.output import fresh, owned
from hno.cli.progress import collect_messages
from hno.cli.results import Results, recorded
from hno.cli.schema import REGISTRIES
from hno.cli.sections import show
from hno.cli.sweep import Entry, Job, Ledger, show_jobs
from hno.cli.swept import named, swept_keys
from hno.evaluation.format import NAMES, counted
from hno.processes import Interrupted, follow, interruptible, passed_on
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
        UsageError: nothing was done, since the configuration makes no run, or its folder is another's.
        Interrupted: a signal ended it.
    """
    if "--multirun" in given.flags:
        return _multirun(task, given)
    settings = configured(task.name, task.check, given)
    if settings is None:
        return 0  # a dry run
    began, succeeded = False, False

    def job(config: DictConfig) -> None:
        nonlocal began, succeeded
        began = True
        succeeded = perform(task, task.check(config), folder) is not None

    register_plugins()
    try:
        folder = _chosen("hydra.run.dir", given, HydraConfig.get().run.dir)
        words = [*for_hydra(task.name, given), f"hydra.run.dir={quoted(str(folder))}"]
        with owned(folder, getattr(settings, "resume", None)):
            print(f"Run: {folder}", flush=True)
            under_hydra(task.name, job, words)
    except Exception as error:
        if began:
            raise
        raise _refusal(error) from error
    print(pages.write(folder))
    return 0 if succeeded else 1


def _chosen(key: str, given: Arguments, folder: str) -> Path:
    """The folder that the command line names; otherwise a new one, also for who starts in the same second."""
    chosen = any(word.lstrip("+").startswith(f"{key}=") for word in given.overrides)
    return Path(folder).absolute() if chosen else fresh(Path(folder).absolute())


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
        with tempfile.TemporaryDirectory() as nowhere, ExitStack() as stack:
            folder = Path(nowhere) if dry else _chosen("hydra.sweep.dir", given, HydraConfig.get().sweep.dir)
            stack.enter_context(owned(folder, jobs=True))
            words = [*_here(words), *QUIET] if dry else [*words, *_named(task, words)]
            if not dry:
                print(f"Sweep: {folder}", flush=True)
            return _swept(task, ["--multirun", *words, f"hydra.sweep.dir={quoted(str(folder))}"], folder, dry)
    except REFUSALS as error:
        raise _refusal(error) from error


def _named(task: Task, words: Sequence[str]) -> list[str]:
    """Name the folders of jobs by what was swept, unless the command line names them."""
    if any(word.lstrip("+").startswith("hydra.sweep.subdir=") for word in words):
        return []
    hydra = HydraConfig.get()
    sweep: Any = OmegaConf.to_container(hydra.sweep)  # as it is written, with its interpolations
    keys = swept_keys(words, hydra.sweeper.get("params") or {})
    folder = quoted(named(str(sweep["subdir"]), keys, groups(task.name)))
    return [f"hydra.sweep.subdir={folder}"] if keys else []


def _here(words: Sequence[str]) -> list[str]:
    """Overrides without the launcher: a dry run stays in this process."""
    return [word for word in words if not word.lstrip("+").startswith(("hydra/launcher", "hydra.launcher"))]


def _swept(task: Task, words: Sequence[str], folder: Path, dry: bool) -> int:
    own, this = {kind: registry().own() for kind, registry in REGISTRIES.items()}, os.getpid()
    failure = None
    with Ledger.within(folder) as ledger:

        def job(config: DictConfig) -> Objective:  # a launcher may send it to another process
            follow(this)
            return _job(task, config, ledger, own, dry)

        try:
            with passed_on(ledger.pass_on):
                under_hydra(task.name, job, words)
        except Exception as error:
            if isinstance(error, REFUSALS) and not ledger.entries():
                raise
            failure = error
        finally:
            found = ledger.entries()
            if found and not dry:
                show_jobs([entry.job for entry in found])
        if ledger.signal is not None:
            stop = Interrupted(ledger.signal)
            stop.add_note(f"{counted(len(found), 'job')} had begun. Go on with each by: hno train resume=<its folder>")
            raise stop
    refused = sum(not entry.succeeded for entry in found)
    if dry:
        print(counted(len(found), "job") + (f", {refused} refused" if refused else ""))
    if failure is not None:
        print(f"The launcher ended before all jobs did: {one_screen(sentence(failure))}", file=sys.stderr)
    return 1 if refused or failure is not None else 0


def _job(task: Task, config: DictConfig, ledger: Ledger, own: Parts, dry: bool) -> Objective:
    """One job of a multirun, perhaps in another process, which is told what the user's own program registered."""
    if ledger.signal is not None:
        return None
    for kind, parts in own.items():
        for name, part in parts.items():
            REGISTRIES[kind]().register(name)(part)
    current = Job.current()
    ledger.write(Entry.begun(current))
    if dry:
        print(f"{current.number}: {' '.join(current.settings)}")
    try:
        settings = task.check(config)
    except Exception as error:
        print(f"   refused: {one_screen(sentence(error))}") if dry else _refuse(task, config, current, error)
        return None
    found = None if dry else _performed(task, settings, current, ledger)
    ledger.write(Entry(current, dry or found is not None))
    return objective(settings, found)


def _performed(task: Task, settings: Any, job: Job, ledger: Ledger) -> Results | None:
    """Do a job in its folder; a signal ends the sweep, not only the job."""
    try:
        with interruptible(), owned(job.folder, getattr(settings, "resume", None)):
            return perform(task, settings, job.folder)
    except Interrupted as stop:
        ledger.stop(stop.number)
    except UsageError as error:
        log.error("%s", error)
    return None


def _refuse(task: Task, config: DictConfig, job: Job, error: Exception) -> None:
    """Leave the reason in the results of a job that is not run: it is no failure of the jobs after it."""
    chosen = HydraConfig.get().runtime.choices
    results = Results(job.folder / "results.json", {group: chosen.get(group) for group in NAMES})
    results.update(status="failed", reason=sentence(error))
    log.error("%s", one_screen(sentence(error)))
    content: Any = OmegaConf.to_container(config, resolve=False)
    refuse_wandb(content, results.content, job.folder, task.name)


def perform(task: Task, settings: Any, folder: Path) -> Results | None:
    """Do one job; its folder gets results.json.

    Returns:
        What came of it; None where it failed, which has been logged and is in its folder.
    """
    collect_messages()
    results = Results(folder / "results.json", task.head(settings))
    try:
        with recorded(results):
            task.work(settings, results)
    except Interrupted as stop:
        if hasattr(settings, "resume"):
            stop.add_note(f"Go on with: hno train resume={shlex.quote(str(folder))}")
        raise
    except Exception as error:
        _log(error)
        return None
    finally:
        finish_wandb(results.content, folder)
    show(results.content, folder)
    return results


def _log(error: Exception) -> None:
    """Log what went wrong: one message for errors that were raised on purpose, a traceback for surprises."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = bool(frames) and Path(frames[-1].filename).is_relative_to(Path(hno.__file__).parent)
    meant = ours and isinstance(error, (ValueError, RuntimeError, UnknownNameError))
    expected = meant or isinstance(error, (OSError, MisconfigurationException))
    log.error("%s", error, exc_info=None if expected else error)
