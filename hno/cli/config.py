"""How configurations are composed and judged."""

from __future__ import annotations

import inspect
import os
import sys
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from hno.cli.arguments import FOLDERS, Arguments, UsageError, rewritten
from hno.cli.confs import CHOSEN, OWN, Folders, choices, config_dir, groups, hidden
from hno.cli.harmless import check_harmless
from hno.cli.schema import GIVEN, REGISTRIES, S, SettingsError, places, validated
from hno.cli.settings import COMMANDS, TrainSettings
from hno.registry import BrokenPluginWarning, options_of, reason, unknown_name


def register_plugins() -> None:
    """Make every registered name without a file a choice of its group, with its options and their defaults."""
    for group in CHOSEN:
        registry, have = REGISTRIES[group](), choices(group)
        for name in registry.names():
            if have.get(name) is None:
                options = options_of(registry.get(name), skip=GIVEN.get(group, ()))
                ConfigStore.instance().store(group=group, name=name, node=_node(group, name, options), package=group)


def _node(group: str, name: str, options: Mapping[str, Any]) -> Any:
    """What would stand in a file: defaults that yaml can hold; an option without a default must be given."""
    if group == "game":
        return {"name": name, "constants": {key: v for key, v in options.items() if type(v) in (int, float)}}
    found = {key: "???" if value is inspect.Parameter.empty else value for key, value in options.items()}
    plain = (bool, int, float, str, tuple, list, dict, type(None))
    node = {"name": name, **{k: list(v) if type(v) is tuple else v for k, v in found.items() if isinstance(v, plain)}}
    if group == "optimizer":
        return {"lr": 3e-3, "schedule": "cosine", "final_lr": 3e-5, **node}
    return node


def for_hydra(name: str, given: Arguments) -> list[str]:
    """Overrides as Hydra takes them, after the user's folder and the plugins are known to it.

    Raises:
        UsageError: a folder of configurations that does not exist.
    """
    folder = given.flags.get("--config-dir")
    if folder is not None and not Path(folder).is_dir():
        raise UsageError(f"--config-dir: there is no folder {folder}.")
    Folders.own = [] if folder is None else [Path(folder)]
    for file in sorted(path for own in Folders.own for path in own.rglob("*.yaml")):
        check_harmless(file)
    for file, origin, first in hidden():
        if origin == OWN:
            raise UsageError(f"{file} could not be chosen: {first} has a file of that name, which counts. Rename it.")
    for what, why in Folders.broken().items():
        warnings.warn(f"{what} cannot be used, so its choices are missing: {why}", BrokenPluginWarning, stacklevel=2)
    Plugins.instance().register(Folders)
    composed, paths, many = groups(name), FOLDERS | places(COMMANDS[name]), "--multirun" in given.flags
    swept: Collection[str] = ()
    if many:  # Hydra lets the command line narrow an experiment's sweep under the same name only
        own = [override for override in given.overrides if override.lstrip("+~").startswith(("experiment=", "hydra"))]
        compose(name, [rewritten(override, composed, (), paths) for override in own])
        swept = HydraConfig.get().sweeper.params or ()
    return [rewritten(override, composed, swept, paths, many) for override in given.overrides]


def compose(name: str, overrides: Sequence[str], *, registered: bool = False) -> DictConfig:
    """A configuration as Hydra composes it, without a job; interpolations that name `hydra` work.

    Args:
        name: the root configuration.
        overrides: as Hydra takes them.
        registered: whether registered classes are known to Hydra; otherwise they are looked up for a choice without a
            file only.

    Raises:
        SettingsError: Hydra cannot compose it.
    """
    try:
        with hydra.initialize_config_dir(str(config_dir()), version_base="1.3"):
            config = hydra.compose(name, overrides=list(overrides), return_hydra_config=True)
    except HydraException as error:
        if registered or not isinstance(error, MissingConfigException):
            raise SettingsError(sentence(error)) from error
        register_plugins()
        return compose(name, overrides, registered=True)
    HydraConfig.instance().set_config(config)
    if config.hydra.job.chdir:
        raise SettingsError(
            "hydra.job.chdir=true would change what relative paths mean, and every result is written into the run's "
            "folder without it. Leave it out."
        )
    OmegaConf.set_struct(config, False)
    del config["hydra"]
    return config


REFUSALS = (HydraException, OmegaConfBaseException, OSError, ValueError, LookupError)
"""What is raised on purpose where a configuration makes no run, besides errors of our own types."""


def sentence(error: Exception) -> str:
    """What an error means: of Hydra's, choices that do not exist and overrides that cannot be read."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file is not None:
        return _missing(error.missing_cfg_file, sorted(error.options or ()))
    if isinstance(error, OverrideParseException):
        return f"{error.override} cannot be read: {str(error).splitlines()[0]}."
    meant = isinstance(error, REFUSALS) or type(error).__module__.startswith("hno.")
    return str(error) if meant else reason(error)


def _missing(file: str, known: list[str]) -> str:
    """That a group has no such choice; a launcher or sweeper that Hydra has no plugin for can be installed."""
    group, _, choice = file.rpartition("/")
    if group in CHOSEN and any(what.startswith(f"{choice} = ") for what in REGISTRIES[group]().broken):
        return REGISTRIES[group]().unknown(choice)
    said = unknown_name("method" if group == "operator" else group, choice, known)
    kind = group.removeprefix("hydra/")
    if kind in ("launcher", "sweeper") and kind != group:
        return f"{said} Where there is a package for it: pip install hydra-{choice.split('_')[0]}-{kind}"
    return " ".join([said, *(f"Could not be loaded: {what}: {why}." for what, why in Folders.broken().items())])


def read(model: type[S], config: DictConfig) -> S:
    """The composed configuration, judged by the schema of its command.

    Top-level entries that an experiment's file declares for its own interpolations are no part of it, nor is what a
    game's file says for trainings where the command does not train.

    Raises:
        SettingsError: see `hno.cli.schema.validated`.
    """
    hydra_config = HydraConfig.get()
    chosen = hydra_config.runtime.choices.get("experiment")
    files = [folder / "experiment" / f"{chosen}.yaml" for folder, _ in Folders.all()]
    helpers = {key for file in files if file.exists() for key in OmegaConf.load(file)}
    given = {override.partition("=")[0].lstrip("+~") for override in hydra_config.overrides.task}
    others = TrainSettings.model_fields.keys() - {key.split(".")[0] for key in given}
    unread = (helpers | others) - model.model_fields.keys()
    try:
        content: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=False)
    except OmegaConfBaseException as error:
        raise SettingsError(str(error)) from error
    return validated(model, {k: v for k, v in content.items() if k not in unread and v != "???"}, given)


def configured(name: str, check: Callable[[DictConfig], S], given: Arguments) -> S | None:
    """The settings of a command; None after a dry run, which prints them.

    Raises:
        UsageError: a configuration that makes no run, whatever the reason: parts from outside raise what they will.
    """
    try:
        settings = check(compose(name, for_hydra(name, given)))
        str(HydraConfig.get().run.dir)  # it can be resolved
    except Exception as error:
        raise UsageError(sentence(error)) from error
    if "--dry-run" not in given.flags:
        return settings
    print(OmegaConf.to_yaml(OmegaConf.create(settings.model_dump())), end="")
    return None


def under_hydra(name: str, job: Callable[[DictConfig], Any], words: Sequence[str]) -> None:
    """Let Hydra run jobs on a command line; its exceptions reach the caller, who says what they mean."""
    before = sys.argv
    sys.argv = [before[0], *words]
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        hydra.main(version_base="1.3", config_path=str(config_dir()), config_name=name)(job)()
    finally:
        sys.argv = before


def complete(name: str, words: Sequence[str]) -> None:
    """Hydra's own completion for shells."""
    Plugins.instance().register(Folders)
    under_hydra(name, lambda config: None, ["--shell-completion", *words])
