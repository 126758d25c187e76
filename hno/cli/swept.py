"""Names for the folders of a multirun's jobs, by what was swept."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from hno.cli.arguments import quoted
from hno.evaluation.format import NAMES
from hno.report.variants import matters

LENGTH = 30
"""Characters of a value in a folder's name, at most."""


def file_name(value: Any) -> str:
    """A value as a part of a file's name: of a path its last part, and nothing that a shell or Hydra would read."""
    return re.sub(r"[^\w.+-]+", "-", str(value).rstrip("/").split("/")[-1]).strip("-")[:LENGTH] or "none"


OmegaConf.register_new_resolver("file_name", file_name, replace=True)


def folders_named(words: Sequence[str], choices: Iterable[str]) -> list[str]:
    """The word that names folders of jobs by what was swept; none where the command line names them.

    Args:
        words: the command line, as Hydra takes it; its configuration was composed last.
        choices: keys that choose from a group.
    """
    if any(word.lstrip("+").startswith("hydra.sweep.subdir=") for word in words):
        return []
    hydra = HydraConfig.get()
    sweep: Any = OmegaConf.to_container(hydra.sweep)  # as it is written, with its interpolations
    keys = swept_keys(words, hydra.sweeper.get("params") or {})
    return [f"hydra.sweep.subdir={quoted(named(str(sweep['subdir']), keys, choices))}"] if keys else []


def swept_keys(words: Iterable[str], params: Mapping[str, Any]) -> list[str]:
    """Keys that a multirun sweeps, those of the configuration first, then those of the command line in its order.

    Args:
        words: the command line, as Hydra takes it.
        params: `hydra.sweeper.params` of the configuration.
    """
    given = [f"{key}={value}" for key, value in params.items()] + [word for word in words if "=" in word]
    parsed = OverridesParser.create().parse_overrides([*given])
    keys = [found.key_or_group for found in parsed if found.is_sweep_override()]
    return [key for key in dict.fromkeys(keys) if matters(key) and key not in NAMES and not key.startswith("hydra")]


def named(subdir: str, keys: Sequence[str], choices: Iterable[str]) -> str:
    """The pattern of the jobs' folders with what was swept at its end.

    Args:
        subdir: `hydra.sweep.subdir` as it is without.
        keys: what was swept, see `swept_keys`.
        choices: keys that choose from a group; the others are settings.
    """
    groups = set(choices)
    places = {key: f"hydra.runtime.choices.{key}" if key in groups else key for key in keys}
    return subdir + "".join(
        f"_{file_name(key.split('.')[-1])}-${{file_name:${{{place}}}}}" for key, place in places.items()
    )
