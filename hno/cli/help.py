"""The help of commands that have a configuration: what can be chosen, and every key with its comment."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]  # yaml has no annotations
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from hno.cli.arguments import Arguments
from hno.cli.config import choices, compose, config_dir, for_hydra, groups
from hno.cli.schema import SettingsError

BESIDE = 44
"""The column of comments."""


def configuration_help(name: str, given: Arguments) -> str:
    """Groups with their choices, and the keys of the configuration that the overrides compose."""
    overrides = for_hydra(name, given)
    try:
        config = compose(name, overrides)
    except SettingsError:  # values of a sweep, or mistakes of which a run will speak
        config = compose(name, [])
    said = dict(comments((config_dir() / f"{name}.yaml").read_text(encoding="utf-8")))
    parts = []
    for group in groups(name):
        known = choices(group)
        chosen = HydraConfig.get().runtime.choices.get(group)
        parts.append(_group(group, known, chosen))
        path = known.get(str(chosen))
        if path is not None:
            text = path.read_text(encoding="utf-8")
            prefix = "" if "@package _global_" in text else f"{group}."
            said.update({prefix + key: comment for key, comment in comments(text)})
    head = "Groups, group=choice (*: chosen)\n" + "\n".join(parts) + "\n\n" if parts else ""
    text = yaml.dump(OmegaConf.to_container(config, resolve=False), Dumper=_Flow, sort_keys=False, width=10**6)
    lines = [(f"  {line}".replace(": ???", ": (required)"), key) for line, key in _keyed(text)]
    keys = [f"{line:<{BESIDE - 2}}  # {said[key]}" if key in said else line for line, key in lines]
    return head + "Keys, key=value\n" + "\n".join(keys)


class _Flow(yaml.SafeDumper):  # type: ignore[misc]  # yaml has no annotations
    """Lists in one line each."""

    def represent_list(self, data: list[Any]) -> Any:
        return self.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=True)


_Flow.add_representer(list, _Flow.represent_list)


def _group(group: str, known: Mapping[str, Path | None], chosen: object) -> str:
    lines = []
    for place, (choice, path) in enumerate(known.items()):
        mark = "*" if choice == chosen else " "
        text = f"  {'' if place else group:<12}{mark}{choice:<16}{'' if path is None else heading(path)}"
        lines.append(text.rstrip())
    return "\n".join(lines)


def comments(text: str) -> Iterator[tuple[str, str]]:
    """Keys of a yaml file, with dots, and the comments that stand behind them."""
    for line, key in _keyed(text):
        comment = re.search(r":(?:|.*\s)#\s*(.+)$", line)
        if comment is not None:
            yield key, comment[1]


def _keyed(text: str) -> Iterator[tuple[str, str]]:
    """Lines of a yaml file that have a key, and the key with dots."""
    above: list[tuple[int, str]] = []
    for line in text.splitlines():
        match = re.match(r"( *)(\w+):", line)
        if match is not None:
            above = [entry for entry in above if entry[0] < len(match[1])] + [(len(match[1]), match[2])]
            yield line, ".".join(key for _, key in above)


def heading(path: Path) -> str:
    """The first sentence of the comment at the head of a yaml file."""
    lines = path.read_text(encoding="utf-8").splitlines()
    head = [line.lstrip("# ") for line in lines if line.startswith("#") and "@package" not in line]
    return re.split(r"(?<=\.) ", " ".join(head))[0].rstrip(".") if lines and lines[0].startswith("#") else ""
