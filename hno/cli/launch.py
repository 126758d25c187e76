"""Runs of `hno train` and `hno evaluate` under Hydra: one, or every job of a multirun."""

from __future__ import annotations

import logging
import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from hno.cli import again, pages
from hno.cli.arguments import Arguments, UsageError, one_screen, quoted
from hno.cli.config import REFUSALS, configured, for_hydra, register_plugins, sentence, under_hydra
from hno.cli.confs import groups
from hno.cli.launchers import check_cluster, in_queue, keep_to, share, spelled, without
from hno.cli.objective import Objective, objective
from hno.cli.output import fresh, owned
from hno.cli.perform import Task, perform, refuse
from hno.cli.schema import REGISTRIES
from hno.cli.sweep import Entry, Job, Ledger, show_jobs
from hno.cli.swept import folders_named
from hno.data.folders import LOCK, held
from hno.evaluation.format import counted
from hno.processes import Interrupted, follow, forsaken, interruptible, passed_on
from hno.report.runs import RESULTS

log = logging.getLogger(__name__)

QUIET = ("hydra/hydra_logging=disabled", "hydra/job_logging=disabled", "hydra.output_subdir=null")


Parts = Mapping[str, Mapping[str, Any]]
"""Classes and functions by kind and name."""


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
    given, before = again.going_on(given)
    given = spelled(given)
    if "--multirun" in given.flags:
        return _multirun(task, given, before)
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


def _multirun(task: Task, given: Arguments, before: Path | None) -> int:
    """Let Hydra's launcher run every job. It ends with a table, also when it is interrupted; a dry one prints its jobs.

    Launchers run jobs in processes of their own: what became of each is in a file of the ledger.

    Args:
        task: of every job.
        given: the command line.
        before: the folder of the sweep that is run again, if one is.
    """
    dry = "--dry-run" in given.flags
    try:
        words = for_hydra(task.name, given)
        words, cores = [*words, *folders_named(words, groups(task.name))], share()
        check_cluster()
        if before is not None:
            again.check_same(before, task.command, words)
        register_plugins()
        if task.search is not None and task.search.check(words, dry):
            return 0
        with tempfile.TemporaryDirectory() as nowhere, ExitStack() as stack:
            folder = Path(nowhere) if dry else _chosen("hydra.sweep.dir", given, HydraConfig.get().sweep.dir)
            stack.enter_context(owned(folder, None if before is None else str(folder), jobs=True))
            words = [*without(words), *QUIET] if dry else words
            if not dry:
                print(f"Sweep: {folder}", flush=True)
            words = ["--multirun", *words, f"hydra.sweep.dir={quoted(str(folder))}"]
            return _swept(task, words, Ledger.within(folder, before, cores), dry)
    except REFUSALS as error:
        raise _refusal(error) from error


def _swept(task: Task, words: Sequence[str], made: AbstractContextManager[Ledger], dry: bool) -> int:
    own = {kind: registry().own() for kind, registry in REGISTRIES.items()}
    failure, queued = None, in_queue()
    with made as ledger:
        command = again.command(task.command, ledger.sweep, () if task.search is None else task.search.place)
        runs = under_hydra if task.search is None else task.search.run

        def job(config: DictConfig) -> Objective:  # a launcher may send it to another process
            follow(ledger.process)
            keep_to(ledger.cores)
            return _job(task, config, ledger, own, dry)

        try:
            with passed_on(ledger.pass_on):
                runs(task.name, job, words)
        except Exception as error:
            if isinstance(error, REFUSALS) and not ledger.entries():
                raise
            failure = error
            if queued:
                ledger.leave()
        finally:
            found = ledger.entries()
            if found and not dry:
                whole = failure is None and (task.search is not None or all(entry.succeeded for entry in found))
                show_jobs([entry.job for entry in found], None if whole else command)
        if ledger.signal is not None:
            stop = Interrupted(ledger.signal)
            stop.add_note(f"{counted(len(found), 'job')} had begun. Go on with: {command}")
            raise stop
    refused = sum(not entry.succeeded for entry in found)
    if dry:
        print(counted(len(found), "job") + (f", {refused} refused" if refused else ""))
    if failure is not None:
        on = " Those that are in the queue go on without it." if queued else ""
        print(f"The launcher ended before all jobs did: {one_screen(sentence(failure))}{on}", file=sys.stderr)
    failed = refused if task.search is None else failure is None and not task.search.succeeded(ledger.sweep)
    return 1 if failed or failure is not None else 0


def _job(task: Task, config: DictConfig, ledger: Ledger, own: Parts, dry: bool) -> Objective:
    """One job of a multirun, perhaps in another process, which is told what the user's own program registered."""
    if ledger.signal is not None:
        return None
    for kind, parts in own.items():
        for name, part in parts.items():
            REGISTRIES[kind]().register(name)(part)
    current = Job.current()
    restarted = ledger.knows(current)
    ledger.write(Entry.begun(current))
    if dry:
        print(f"{current.number}: {' '.join(current.settings)}")
    try:
        settings = task.check(config)
        if dry:
            found = _foreseen(task, settings, current, ledger)
        else:
            found = _performed(task, settings, config, current, ledger, restarted)
    except Exception as error:
        print(f"   refused: {one_screen(sentence(error))}") if dry else _refuse(task, config, current, error, ledger)
        return None
    ledger.write(found)
    if not dry:
        ledger.tell(found.job)
    return objective(settings, found.job.results()) if found.succeeded and not dry else None


def _foreseen(task: Task, settings: Any, job: Job, ledger: Ledger) -> Entry:
    """What would become of a job; of one that has begun before, it is said."""
    there = ledger.there(job)
    if there is not None:
        how = "at work" if held(there / LOCK) else again.planned(there, settings, task.reads(settings))
        print(f"   {how}") if how else None
    return Entry(job, succeeded=True)


def _performed(task: Task, settings: Any, config: DictConfig, job: Job, ledger: Ledger, restarted: bool) -> Entry:
    """Do a job in its folder, or what is left of it; a signal ends the sweep, if it is not this job's process alone.

    Args:
        task: of the job.
        settings: of the job.
        config: what they were made of.
        job: it.
        ledger: of the sweep.
        restarted: whether it began in this sweep already: a cluster begins it again where a node fails.
    """
    goes_on = (ledger.before is not None or restarted) and (job.folder / RESULTS).exists()
    try:
        with interruptible(), owned(job.folder, str(job.folder) if goes_on else getattr(settings, "resume", None)):
            if goes_on:
                job = job._replace(how=again.planned(job.folder, settings, task.reads(settings)))
                ledger.write(Entry.begun(job))
            if job.how == again.SKIPPED:
                return Entry(job, succeeded=True)
            if job.how == again.REPEATED:
                again.clear(job.folder)
            elif job.how == again.RESUMED_JOB:
                config.resume = str(job.folder)
                settings = task.check(config)
            return Entry(job, perform(task, settings, job.folder) is not None)
    except Interrupted as stop:
        if ledger.process == os.getpid() or forsaken():
            ledger.stop(stop.number)
    return Entry(job)


def _refuse(task: Task, config: DictConfig, job: Job, error: Exception, ledger: Ledger) -> None:
    """Leave the reason in the results of a job that is not run: the jobs after it go on.

    Not in a folder that is another's (a `UsageError`), or has results of its own.
    """
    job = job._replace(refusal=sentence(error))
    if not isinstance(error, UsageError) and again.results(job.folder).get("status", "failed") == "failed":
        refuse(task, config, job.folder, job.refusal)
    log.error("%s", one_screen(job.refusal))
    ledger.write(Entry(job))
    ledger.tell(job)
