"""Where the configuration lies, what may be chosen, and messages for choices that do not exist."""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

import hno
from hno.cli import pages
from hno.cli.results import Results
from hno.cli.sweep import Job, show_jobs
from hno.games import games
from hno.operators import activations, networks
from hno.registry import Registry, unknown_name

log = logging.getLogger(__name__)

PLUGGABLE: dict[str, Registry[Any]] = {"game": games, "network": networks, "activation": activations}
"""Groups whose choices are registered classes."""


def config_dir() -> Path:
    """The folder `conf`: inside an installed package, beside the package in a checkout."""
    package = Path(hno.__file__).parent
    found = next((folder for folder in (package / "conf", package.parent / "conf") if folder.is_dir()), None)
    if found is None:
        raise FileNotFoundError(f"The configuration folder conf/ is missing beside {package}. Install hno again.")
    return found


def register_plugins() -> None:
    """Make every registered name a choice of its group, also those without a yaml file."""
    for group, registry in PLUGGABLE.items():
        for name in registry.names():
            if not (config_dir() / group / f"{name}.yaml").exists():
                node: dict[str, Any] = {"game": {"name": name, "constants": {}}} if group == "game" else {"name": name}
                package = "_global_" if group == "game" else None
                ConfigStore.instance().store(group=group, name=name, node=node, package=package)


def choices(group: str) -> list[str]:
    """Choices of a configuration group."""
    names = {path.stem for path in (config_dir() / group).glob("*.yaml")}
    return sorted(names | set(PLUGGABLE[group].names() if group in PLUGGABLE else ()))


def check_choices(arguments: Sequence[str]) -> None:
    """Refuse group choices that do not exist, with the known ones and the nearest.

    Raises:
        SystemExit: a choice does not exist.
    """
    if any(argument.startswith(("--config-dir", "-cd")) for argument in arguments):
        return  # choices may come from the user's own folder; Hydra lists them
    groups = {path.name for path in config_dir().iterdir() if path.is_dir()}
    for argument in arguments:
        match = re.fullmatch(r"\+?([a-z_]+)=([\w.,-]+)", argument)
        if match is None or match[1] not in groups:
            continue
        for name in match[2].split(","):
            if name not in (*choices(match[1]), "null", ""):
                sys.exit(unknown_name(match[1], name, choices(match[1])))


def explain(error: Exception) -> str:
    """The message of a configuration error; unknown keys come with the known ones and the nearest."""
    cause = error.__cause__
    if isinstance(cause, (ConfigAttributeError, ConfigKeyError)) and isinstance(cause.parent_node, DictConfig):
        if str(cause.full_key).startswith("game.constants."):
            return f"Constants of a game need a plus sign: write +{cause.full_key}=<value>."
        if str(cause.full_key).startswith("conditions."):
            value = "<value>" if str(cause.full_key).count(".") > 1 else "{...}"
            return f"New conditions and entries of conditions need a plus sign: write +{cause.full_key}={value}."
        known = sorted(str(key) for key in cause.parent_node)
        return f"{cause.full_key} does not exist. " + unknown_name("configuration key", str(cause.key), known)
    return str(error)


def run_command(config_name: str, task: Callable[[DictConfig], bool]) -> None:
    """Run a task under Hydra, in every job of a multirun, and exit with 1 if one of them failed.

    A multirun ends with a table of its jobs, also when it is interrupted. The last line is the path of the page, which
    failed runs have too.

    Args:
        config_name: the root configuration.
        task: does one job; false if it failed (it has said why).
    """
    check_choices(sys.argv[1:])
    sys.argv[1:] = [re.sub(r"^theta=([^'\"]*[,;].*)$", r"theta='\1'", argument) for argument in sys.argv[1:]]
    register_plugins()
    outcomes: list[bool] = []
    jobs: list[Job] = []
    folders: list[Path] = []
    os.environ["HYDRA_FULL_ERROR"] = "1"  # exceptions reach this function; it says what they mean

    def job(config: DictConfig) -> None:
        current = Job.current()
        jobs.extend([] if current is None else [current])
        folders.append(Path(HydraConfig.get().runtime.output_dir))
        outcomes.append(_attempt(task, config))

    try:
        hydra.main(version_base="1.3", config_path=str(config_dir()), config_name=config_name)(job)()
    except OSError as error:
        sys.exit(f"The output folder cannot be written ({error}). Choose another with hydra.run.dir=<folder>.")
    except (HydraException, OmegaConfBaseException) as error:
        sys.exit(explain(error))
    finally:
        if jobs:
            show_jobs(jobs)
    if not jobs:
        for folder in folders:
            if (folder / "results.json").exists():
                print(pages.write(folder))
    if not all(outcomes):
        sys.exit(1)


def _attempt(task: Callable[[DictConfig], bool], config: DictConfig) -> bool:
    """Run a task; a configuration that cannot be resolved is a failure of its own, not of the jobs after it."""
    try:
        return task(config)
    except OmegaConfBaseException as error:
        hydra_config = HydraConfig.get()
        chosen = {group: hydra_config.runtime.choices.get(group) for group in PLUGGABLE}
        path = Path(hydra_config.runtime.output_dir) / "results.json"
        Results(path, chosen).update(status="failed", reason=explain(error))
        log.error("%s", explain(error))
        return False
