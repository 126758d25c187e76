"""One job: its work, what it leaves, and what is said of it."""

from __future__ import annotations

import logging
import shlex
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from hydra.core.hydra_config import HydraConfig
from lightning.fabric.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig, OmegaConf

import hno
from hno.cli.logs import finish_wandb, refuse_wandb
from hno.cli.progress import collect_messages
from hno.cli.results import PrunedError, Results, recorded
from hno.cli.sections import show
from hno.evaluation.format import NAMES
from hno.processes import Interrupted
from hno.registry import UnknownNameError
from hno.report.runs import RESULTS

log = logging.getLogger(__name__)


class JobSearch(Protocol):
    """What chooses the jobs of a multirun where they are no grid."""

    @property
    def command(self) -> str:
        """Its command."""

    @property
    def place(self) -> Sequence[str]:
        """Words of the command line that no file may say: they are given again where it goes on."""

    def check(self, words: Sequence[str], dry: bool) -> bool:
        """Judge a command line before anything is written; whether that was all, since a dry one is printed."""

    def run(self, name: str, job: Callable[[DictConfig], Any], words: Sequence[str]) -> None:
        """Let a launcher run jobs of a root configuration."""

    def succeeded(self, folder: Path) -> bool:
        """Whether what is in the folder of the sweep is worth something, though some of its jobs failed."""


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
    reads: Callable[[Any], Sequence[Path]] = lambda settings: ()
    """Files whose change makes results that are older worthless, from the settings."""
    search: JobSearch | None = None
    """What chooses the jobs of a multirun; None for Hydra's grid."""

    @property
    def command(self) -> str:
        """What a multirun of it goes on with."""
        return self.name if self.search is None else self.search.command


def perform(task: Task, settings: Any, folder: Path) -> Results | None:
    """Do one job; its folder gets results.json.

    Returns:
        What came of it, also where it was pruned; None where it failed, which has been logged and is in its folder.
    """
    collect_messages()
    results = Results(folder / RESULTS, task.head(settings))
    try:
        with recorded(results):
            task.work(settings, results)
    except Interrupted as stop:
        if hasattr(settings, "resume"):
            stop.add_note(f"Go on with: hno train resume={shlex.quote(str(folder))}")
        raise
    except PrunedError as stop:
        log.info("%s", stop)
        return results
    except Exception as error:
        _log(error)
        return None
    finally:
        finish_wandb(results.content, folder)
    show(results.content, folder)
    return results


def refuse(task: Task, config: DictConfig, folder: Path, reason: str) -> None:
    """Leave the reason in the results of a job that is not run, and in W&B where its configuration asks for that."""
    chosen = HydraConfig.get().runtime.choices
    results = Results(folder / RESULTS, {group: chosen.get(group) for group in NAMES})
    results.update(status="failed", reason=reason)
    content: Any = OmegaConf.to_container(config, resolve=False)
    refuse_wandb(content, results.content, folder, task.name)


def _log(error: Exception) -> None:
    """Log what went wrong: one message for errors that were raised on purpose, a traceback for surprises."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = bool(frames) and Path(frames[-1].filename).is_relative_to(Path(hno.__file__).parent)
    meant = ours and isinstance(error, (ValueError, RuntimeError, UnknownNameError))
    expected = meant or isinstance(error, (OSError, MisconfigurationException))
    log.error("%s", error, exc_info=None if expected else error)
