"""The help of commands that have a configuration: what can be chosen, and every key with its comment."""

from __future__ import annotations

import re
import sys
import textwrap
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from shutil import get_terminal_size
from typing import Any

import yaml  # type: ignore[import-untyped]  # yaml has no annotations
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from hno.cli.arguments import Arguments
from hno.cli.config import compose, for_hydra
from hno.cli.confs import choices, config_dir, groups
from hno.cli.launchers import LAUNCHERS, installed
from hno.cli.schema import SettingsError

BESIDE = 44
"""The column of comments."""
ABOUT = {
    "game": "the physics; its constructor's arguments are game.constants.<name>",
    "operator": "the method: loss terms and their weights",
    "function": "what is learned",
    "network": "what the function is made of",
    "activation": "of the network",
    "data": "labels: types, how many, batches, phases of the training",
    "sampler": "where collocation points lie",
    "loss": "norm, scale and balance of the terms",
    "optimizer": "how weights are found, and at which rate",
    "trainer": "how long and on what; trainer.<argument> takes the others of lightning.Trainer, such as deterministic",
    "logger": "where numbers go besides results.json",
    "evaluation": "what is measured at the end",
    "validation": "what is measured while training, and chooses the best checkpoint",
    "callbacks": "of Lightning, by registered names; several as [a,b]",
    "profiler": "where time goes",
    "experiment": "a named recipe that sets several of these",
    "debug": "a run that looks for a mistake; it is laid over all the others",
}
"""What every group is for."""
SWEPT = "train", "evaluate"
"""Commands that take -m."""


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
        chosen = _names(HydraConfig.get().runtime.choices.get(group))
        parts.append(_group(group, known, chosen))
        said[f"{group}.name"] = f"chosen by {group}=<name>"
        for path in (known[one] for one in ("default", *chosen) if known.get(one) is not None):
            said.update(_comments_of(path, group))
    if name in SWEPT:
        parts.append(_launchers())
    head = "Groups, group=choice (*: chosen)\n" + "\n".join(parts) + "\n\n" if parts else ""
    text = yaml.dump(OmegaConf.to_container(config, resolve=False), Dumper=_Flow, sort_keys=False, width=10**6)
    lines = [(f"  {line}".replace(": ???", ": (required)"), key) for line, key in _keyed(text)]
    keys = [f"{line:<{BESIDE - 2}}  # {said[key]}" if key in said else line for line, key in lines]
    return head + "Keys, key=value\n" + "\n".join(_folded(line, " " * BESIDE + "# ") for line in keys)


class _Flow(yaml.SafeDumper):  # type: ignore[misc]  # yaml has no annotations
    """Lists in one line each."""

    def represent_list(self, data: list[Any]) -> Any:
        return self.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=True)


_Flow.add_representer(list, _Flow.represent_list)


def _names(chosen: Any) -> list[str]:
    """Choices of a group: none, one, or several in a list."""
    if OmegaConf.is_list(chosen) or isinstance(chosen, list):
        return [str(one) for one in chosen]
    return re.findall(r"\w+", str(chosen)) if chosen not in (None, "null") else []


def _comments_of(path: Any, group: str) -> dict[str, str]:
    """Comments of a file of a group, by the key in the whole configuration."""
    text = Path(path).read_text(encoding="utf-8")
    package = re.search(r"@package (\S+)", text)
    place = package[1] if package else group
    return {key if place == "_global_" else f"{place}.{key}": comment for key, comment in comments(text)}


def _group(group: str, known: Mapping[str, Path | None], chosen: Collection[str]) -> str:
    lines = [f"  {group}: {ABOUT[group]}"]
    for choice, path in known.items():
        mark = "*" if choice in chosen else " "
        lines.append(f"    {mark} {choice:<16}{'' if path is None else heading(path)}".rstrip())
    return "\n".join(_folded(line, " " * 22) for line in lines)


def _launchers() -> str:
    """Launchers as a group, and how those that are not installed can be."""
    lines = ["  launcher: with -m, what runs the jobs; launcher.<option>=<value>"]
    for name, launcher in LAUNCHERS.items():
        lines.append(f"    {'*' if name == 'basic' else ' '} {name:<16}{launcher.about}{_missing(name)}")
    return "\n".join(_folded(line, " " * 22) for line in lines)


def _missing(name: str) -> str:
    return "" if installed(LAUNCHERS[name]) else f" (not installed: pip install 'hno[{name}]')"


def _folded(line: str, indent: str) -> str:
    """A line as wide as the terminal, if there is one; what follows is indented."""
    if not sys.stdout.isatty():
        return line
    return textwrap.fill(line, max(60, get_terminal_size().columns), subsequent_indent=indent, break_long_words=False)


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
