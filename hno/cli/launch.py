"""Runs of `hno train` and `hno evaluate` under Hydra: one, or every job of a multirun."""

from __future__ import annotations

import logging
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from hno.cli import pages
from hno.cli.arguments import Arguments
from hno.cli.config import compose, for_hydra, quoted, register_plugins, under_hydra
from hno.cli.results import Results
from hno.cli.schema import S, Settings
from hno.cli.sweep import Job, counted, show_jobs
from hno.training.checkpoint import CheckpointError

log = logging.getLogger(__name__)

REFUSALS = (HydraException, OmegaConfBaseException, CheckpointError, ValueError, LookupError)
"""What a configuration raises that makes no run."""
NAMED = ("game", "operator", "activation")
"""Groups that name a job in results.json."""


def run(name: str, check: Callable[[DictConfig], S], task: Callable[[S], bool], given: Arguments) -> int:
    """Check configurations and run a task on each, in every job of a multirun.

    A multirun ends with a table of its jobs, also when it is interrupted. The last line is the path of the page, which
    failed runs have too; a configuration that is refused leaves no folder, in a multirun its reason alone.

    Args:
        name: the root configuration.
        check: judges a composed configuration before its work and returns its settings.
        task: does one job; false if it failed (it has said why).
        given: the command line.

    Returns:
        The exit code: 1 if a job failed.
    """
    overrides = for_hydra(name, given)
    register_plugins()
    many, dry = "--multirun" in given.flags, "--dry-run" in given.flags
    try:
        if not many:
            config = compose(name, overrides)
            settings = check(config)
            if dry:
                print(OmegaConf.to_yaml(OmegaConf.create(settings.model_dump())), end="")
                return 0
        elif dry:
            return _dry_jobs(name, check, overrides)
        return _run_jobs(name, check, task, [*given.hydra, *overrides])
    except OSError as error:
        return _refuse(f"The output folder cannot be written ({error}). Choose another with --to <folder>.")
    except REFUSALS as error:
        return _refuse(str(error))


def _refuse(message: str) -> int:
    print(message, file=sys.stderr)
    return 1


def _run_jobs(name: str, check: Callable[[DictConfig], S], task: Callable[[S], bool], words: Sequence[str]) -> int:
    outcomes: list[bool] = []
    jobs: list[Job] = []
    folders: list[Path] = []

    def job(config: DictConfig) -> None:
        current = Job.current()
        jobs.extend([] if current is None else [current])
        try:
            settings = check(config)
        except Exception as error:
            outcomes.append(_refused(error))
            return
        folders.append(Path(HydraConfig.get().runtime.output_dir))
        outcomes.append(task(settings))

    try:
        under_hydra(name, job, words)
    finally:
        if jobs:
            show_jobs(jobs)
    for folder in folders if not jobs else ():
        if (folder / "results.json").exists():
            print(pages.write(folder))
    return 0 if all(outcomes) else 1


def _refused(error: Exception) -> bool:
    """Leave the reason in the results of a job that is not run: it is no failure of the jobs after it."""
    found, reason = HydraConfig.get(), str(error)
    chosen = {group: found.runtime.choices.get(group) for group in NAMED}
    Results(Path(found.runtime.output_dir) / "results.json", chosen).update(status="failed", reason=reason)
    log.error("%s", reason, exc_info=None if isinstance(error, REFUSALS) else error)
    return False


def _dry_jobs(name: str, check: Callable[[DictConfig], Settings], overrides: Sequence[str]) -> int:
    """Print the jobs of a multirun, and why some would be refused."""
    outcomes: list[bool] = []

    def job(config: DictConfig) -> None:
        found = Job.current()
        assert found is not None
        reason = ""
        try:
            check(config)
        except REFUSALS as error:
            reason = f"\n   refused: {error}"
        outcomes.append(not reason)
        print(f"{found.number}: {' '.join(found.settings)}{reason}")

    quiet = ["hydra/hydra_logging=disabled", "hydra/job_logging=disabled", "hydra.output_subdir=null"]
    with tempfile.TemporaryDirectory() as folder:
        under_hydra(name, job, ["--multirun", *overrides, *quiet, f"hydra.sweep.dir={quoted(folder)}"])
    refused = outcomes.count(False)
    print(counted(len(outcomes)) + (f", {refused} refused" if refused else ""))
    return 1 if refused else 0
