"""Launchers by short names: what runs the jobs of a sweep, and whether it can here."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
from collections.abc import Sequence
from typing import NamedTuple

from hydra.core.hydra_config import HydraConfig

from hno.cli.arguments import Arguments, UsageError
from hno.registry import unknown_name


class Launcher(NamedTuple):
    """A launcher of Hydra's."""

    choice: str
    """Its name in the group hydra/launcher."""
    about: str
    module: str | None = None
    """Where its plugin lies; None for Hydra's own."""
    words: tuple[str, ...] = ()
    """Options that are others than the plugin's defaults."""


LAUNCHERS = {
    "basic": Launcher("basic", "one job after the other, in this process"),
    "joblib": Launcher(
        "joblib", "as many jobs at once as this machine has cores, or launcher.n_jobs", "hydra_joblib_launcher"
    ),
    "slurm": Launcher(
        "submitit_slurm", "jobs of a Slurm cluster: launcher.partition, .cpus_per_task, .timeout_min, .mem_gb",
        "hydra_submitit_launcher", ("hydra.launcher.cpus_per_task=1",),
    ),
    "ray": Launcher(
        "ray", "tasks of Ray, on this machine or on the cluster at launcher.ray.init.address", "hydra_ray_launcher",
        ("+hydra.launcher.ray.remote.num_cpus=1",),
    ),
}  # fmt: skip
"""By the name that the command line knows, which is also the extra that installs it."""


def spelled(given: Arguments) -> Arguments:
    """The command line with launcher=NAME and launcher.KEY=VALUE as Hydra spells them.

    Raises:
        UsageError: no launcher of that name, one that is not installed, or no sweep that it could run.
    """
    words = list[str]()
    for override in given.overrides:
        key, _, value = override.lstrip("+").partition("=")
        if key != "launcher":
            words.append(override.replace("launcher", "hydra.launcher", 1) if key.startswith("launcher.") else override)
            continue
        if value not in LAUNCHERS:
            more = "All jobs have the same one; hydra/launcher=<name> takes others that Hydra has plugins for."
            raise UsageError(f"{unknown_name('launcher', value, list(LAUNCHERS))} {more}")
        if not installed(LAUNCHERS[value]):
            raise UsageError(f"launcher={value} needs packages that are not installed: pip install 'hno[{value}]'.")
        words += [f"hydra/launcher={LAUNCHERS[value].choice}", *LAUNCHERS[value].words]
    if words != given.overrides and "--multirun" not in given.flags:
        raise UsageError("launcher= runs the jobs of a sweep: add -m, or leave it out for a single run.")
    return given._replace(overrides=words)


def without(words: Sequence[str]) -> list[str]:
    """Overrides without the launcher: a dry run stays in this process."""
    return [word for word in words if not word.lstrip("+").startswith(("hydra/launcher", "hydra.launcher"))]


def installed(launcher: Launcher) -> bool:
    """Whether its plugin is; nothing is imported."""
    if launcher.module is None:
        return True
    return importlib.util.find_spec("hydra_plugins") is not None and (
        importlib.util.find_spec(f"hydra_plugins.{launcher.module}") is not None
    )


def check_cluster() -> None:
    """Refuse a cluster that is not there, if the configuration that was composed last asks for one.

    Raises:
        UsageError: with the reason.
    """
    if not in_queue():
        return
    advice = "Start the sweep where `sinfo` shows the cluster, or choose launcher=joblib."
    if any(shutil.which(program) is None for program in ("sbatch", "srun", "sinfo")):
        raise UsageError(f"There is no Slurm on this machine (no sbatch, srun and sinfo). {advice}")
    try:
        subprocess.run(["sinfo"], check=True, capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.SubprocessError) as error:
        said = " ".join((getattr(error, "stderr", None) or str(error)).split())
        raise UsageError(f"Slurm does not answer: {said}. {advice}") from error


def in_queue() -> bool:
    """Whether the launcher that was composed last leaves jobs to a queue, which goes on without it."""
    return HydraConfig.get().runtime.choices.get("hydra/launcher") == LAUNCHERS["slurm"].choice


def share() -> int | None:
    """Cores for each job of the sweep that was composed last, where its launcher runs several at once and says so."""
    launcher = HydraConfig.get().launcher
    if launcher.get("n_jobs") is not None:
        import joblib

        from hno.pontryagin.threads import cores  # not at the top: help does without torch

        return max(1, cores() // joblib.effective_n_jobs(launcher.n_jobs))
    if launcher.get("ray") is not None:
        return max(1, int(launcher.ray.remote.get("num_cpus") or 1))
    return None


def keep_to(count: int | None) -> None:
    """Let this process, and those that it starts, use so many cores; None for all."""
    if count is not None:
        os.environ["LOKY_MAX_CPU_COUNT"] = str(count)
