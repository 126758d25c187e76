"""What Hydra leaves beside results: the configuration as written, overrides, and how many jobs a sweep has."""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError  # type: ignore[import-untyped]  # yaml has no annotations

from hno.report.records import UnreadableError


def read_yaml(path: Path) -> Any:
    """Content of a YAML file as it is written, interpolations too; None where there is none."""
    if not path.exists():
        return None
    try:
        return OmegaConf.to_container(OmegaConf.load(path))
    except (OSError, ValueError, YAMLError, OmegaConfBaseException) as error:
        raise UnreadableError(f"{path.name} is not YAML ({str(error).splitlines()[0]:.80})") from error


def command_of(folder: Path) -> str | None:
    """The command line that repeats a job; None where Hydra's files are missing or damaged."""
    try:
        overrides, hydra = (read_yaml(folder / ".hydra" / name) for name in ("overrides.yaml", "hydra.yaml"))
    except UnreadableError:
        return None
    return None if not isinstance(overrides, list) else _command_line(hydra, overrides)


def _command_line(hydra: Any, arguments: list[Any]) -> str:
    """What to type; the script is named after Hydra's job."""
    job = _dig(hydra, "hydra", "job", "name") or "train"
    return shlex.join(["python", f"{job}.py", *(str(argument) for argument in arguments)])


def _dig(content: Any, *keys: str) -> Any:
    for key in keys:
        content = content.get(key) if isinstance(content, dict) else None
    return content


def sweep_of(path: Path) -> tuple[str | None, int | None]:
    """The command line of a sweep and how many jobs it has."""
    try:
        content = read_yaml(path)
    except UnreadableError:
        return None, None
    overrides = _dig(content, "hydra", "overrides", "task")
    if not isinstance(overrides, list):
        return None, None
    params = _dig(content, "hydra", "sweeper", "params")
    swept = [f"{key}={value}" for key, value in params.items()] if isinstance(params, dict) else []
    return _command_line(content, ["-m", *overrides]), _jobs([*swept, *map(str, overrides)])


def _jobs(overrides: list[str]) -> int | None:
    """Number of jobs; of overrides of one key, the last counts, as for Hydra."""
    try:
        parsed = OverridesParser.create().parse_overrides(overrides)
        last = {entry.get_key_element(): entry for entry in parsed}
        return math.prod(
            len(list(entry.sweep_string_iterator())) if entry.is_sweep_override() else 1 for entry in last.values()
        )
    except HydraException:
        return None
