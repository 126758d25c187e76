"""Going on with a run: where it lies, its own configuration, and what may be different from now on."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from hno.cli.arguments import FOLDERS, Arguments, as_path, quoted
from hno.cli.schema import Settings, SettingsError
from hno.cli.settings import TrainSettings
from hno.data.store import replace_whole
from hno.report.runs import METRICS, RESULTS
from hno.training.checkpoint import find_checkpoint, flat, same_run
from hno.training.saving import BEST, LAST, RESUMED, read_content

WATCHING = ("profiler", "detect_anomaly", "enable_model_summary", "log_every_n_steps", "max_time")
"""Entries of `trainer` that watch the steps or end them."""
FREE: dict[str, Any] = {
    **dict.fromkeys(("logger", "evaluation", "resume", "objective", "tags", "notes", "callbacks"), True),
    "data": {"cache", "workers"},
    "trainer": {"max_steps", "accelerator", "devices", "print_every", "threads", "strategy", *WATCHING},
    "validation": {"stop_when_safe"},
}
"""What a training does not depend on: it may be different in a run that goes on."""


def training(settings: TrainSettings) -> dict[str, Any]:
    """What the steps of a training depend on, by dotted keys."""
    planned = settings.trainer.schedule_steps or settings.trainer.max_steps
    return flat(settings.model_dump(exclude=FREE)) | {"trainer.schedule_steps": planned}


def training_hash(settings: TrainSettings) -> str:
    """Hash of what the steps of a training depend on."""
    return hashlib.sha256(json.dumps(training(settings), sort_keys=True).encode()).hexdigest()[:16]


def run_folder(place: str | Path) -> Path:
    """The folder of a run, which is named by itself or by the checkpoints that it can go on from."""
    path = Path(place)
    return path.parent if path.name in RESUMED else path


def found_results(folder: Path) -> dict[str, Any]:
    """What results.json says of a training.

    Raises:
        SettingsError: it cannot be read, or is of something else.
        CheckpointError: there is no run.
    """
    path = folder / RESULTS
    if not path.exists():
        find_checkpoint(folder, RESUMED)
    try:
        content = json.loads(path.read_text())
        if isinstance(content["config"]["trainer"], dict):
            return dict(content)
        raise ValueError("it is of no training")
    except (OSError, ValueError, LookupError, TypeError) as error:
        reason = getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"
        raise SettingsError(
            f"There is no run to go on with in {folder}: {path} cannot be read ({reason}). resume=<folder> takes the "
            "folder of a run of `hno train`."
        ) from error


def in_its_folder(given: Arguments) -> Arguments:
    """A single run that goes on does so where it lies, unless another folder is named; Hydra's own files there stay."""
    words = [override.lstrip("+").partition("=") for override in given.overrides]
    places = [value for key, _, value in words if key == "resume"]
    if not places or "--multirun" in given.flags or any(key in FOLDERS for key, *_ in words):
        return given
    place = OverridesParser.create().parse_override(f"resume={as_path(places[-1])}").value()
    if not place:
        return given
    own = [f"hydra.run.dir={quoted(str(run_folder(str(place))))}", "hydra.output_subdir=null"]
    return given._replace(overrides=[*given.overrides, *own])


def own_configuration(config: DictConfig) -> DictConfig:
    """The configuration of the run that is resumed, if one is, under what the command line says besides.

    An experiment is a whole configuration and takes its place. If the run becomes longer, what was laid out over its
    steps stays as it was.

    Args:
        config: as Hydra composed it.

    Raises:
        SettingsError: see `found_results`.
    """
    if not config.get("resume"):
        return config
    stored = found_results(run_folder(str(config.resume)))["config"]
    words = [override.lstrip("+~") for override in HydraConfig.get().overrides.task]
    keys = [re.split("[@=]", word)[0] for word in words]
    merged = config if "experiment" in keys else OmegaConf.create({**stored, "resume": config.resume})
    if merged is not config:
        for key in keys:
            OmegaConf.update(merged, key, OmegaConf.select(config, key), merge=False, force_add=True)
    before = stored["trainer"]
    planned = before.get("schedule_steps") or before.get("max_steps")
    if merged.trainer.get("schedule_steps") is None and merged.trainer.get("max_steps") != planned:
        OmegaConf.update(merged, "trainer.schedule_steps", planned, force_add=True)
    return merged


def check_same_training(settings: TrainSettings) -> None:
    """Refuse to go on with a run whose steps would depend on something else.

    Raises:
        SettingsError: with every key that differs, and both values.
    """
    folder = run_folder(str(settings.resume))
    stored, wanted = _training_before(folder), training(settings)
    if differing := _differing(stored, wanted):
        pairs = "\n".join(f"  {key}: {was!r}, now {now!r}" for key, (was, now) in differing.items())
        raise SettingsError(
            f"The run in {folder} cannot go on with another game, data or operator:\n{pairs}\nLeave these keys out: "
            "resume=<folder> takes the run's own configuration. Or train anew, without resume."
        )


def _training_before(folder: Path) -> dict[str, Any]:
    try:
        return training(TrainSettings.model_validate({**found_results(folder)["config"], "resume": None}))
    except ValueError as error:
        raise SettingsError(f"{folder / RESULTS} does not hold the configuration of a run: {error}") from error


def _differing(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    keys = sorted(before.keys() | after.keys())
    return {key: (before.get(key), after.get(key)) for key in keys if before.get(key) != after.get(key)}


def newest(folder: Path) -> Path | None:
    """The newest sound checkpoint to go on from; None where a run was killed before its first one.

    Raises:
        CheckpointError: all are damaged.
    """
    return find_checkpoint(folder, RESUMED) if any((folder / name).exists() for name in RESUMED) else None


def changes(settings: Settings, before: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Keys that differ from those in the results of a run, with both values."""
    now = json.loads(json.dumps(settings.model_dump(exclude={"resume"})))
    return _differing(flat(before["config"]), flat(now))


def finished(settings: TrainSettings) -> dict[str, Any] | None:
    """The results of the run that is resumed, if it is finished and nothing is different."""
    before = found_results(run_folder(str(settings.resume)))
    return before if before["status"] == "finished" and not changes(settings, before) else None


def history(settings: TrainSettings) -> dict[str, Any]:
    """What the results of a run that goes on keep of those before, and in "resumed" where and how it goes on."""
    folder = run_folder(str(settings.resume))
    before, path = found_results(folder), newest(folder)
    now = {
        "step": 0 if path is None else read_content(path)["global_step"],
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "checkpoint": None if path is None else str(path),
        "changes": changes(settings, before),
    }
    return {"seconds": before["seconds"], "resumed": [*before.get("resumed", []), now]}


def take_over(place: str | None, folder: Path) -> Path | None:
    """Bring what a run goes on from into its folder; a best checkpoint of another run there goes.

    Returns:
        The checkpoint to go on from, if there is one.
    """
    before = folder if place is None else run_folder(place)
    resume = None if place is None else newest(before)
    ours = resume is not None and same_run(before / BEST, resume)
    if not ours:
        (folder / BEST).unlink(missing_ok=True)
    if resume is None or before.resolve() == folder.resolve():
        return resume
    (folder / METRICS).parent.mkdir(exist_ok=True)
    best = {BEST: before / BEST} if ours else {}
    for name, old in {str(METRICS): before / METRICS, **best, LAST: resume}.items():  # killed before the last: anew
        if old.exists():
            replace_whole(folder / name, partial(shutil.copyfile, old))
    return folder / LAST
