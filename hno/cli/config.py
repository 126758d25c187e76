"""Where configurations lie, what may be chosen in them, and how they are composed."""

from __future__ import annotations

import importlib.util
import inspect
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.errors import HydraException, OverrideParseException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import hno
from hno.cli.arguments import Arguments, UsageError, rewritten
from hno.cli.kinds import GIVEN, REGISTRIES
from hno.cli.schema import S, SettingsError, validated
from hno.registry import options_of, plural, unknown_name

CHOSEN = ("game", "operator", "network", "activation", "optimizer")
"""Groups whose choices are registered; methods of `operator` are files, its functions become methods."""


def config_dir() -> Path:
    """The folder `conf`: inside an installed package, beside the package in a checkout."""
    package = Path(hno.__file__).parent
    found = next((folder for folder in (package / "conf", package.parent / "conf") if folder.is_dir()), None)
    if found is None:
        raise FileNotFoundError(f"The configuration folder conf/ is missing beside {package}. Install hno again.")
    return found


class Folders(SearchPathPlugin):
    """Folders of configuration files besides our own: `conf` of packages that offer plugins, and --config-dir."""

    own: Sequence[Path] = ()
    """The user's."""

    @classmethod
    def all(cls) -> list[Path]:
        """Every folder, ours first."""
        points = [point for kind in REGISTRIES for point in entry_points(group=f"hno.{plural(kind)}")]
        specs = (importlib.util.find_spec(name) for name in sorted({point.module.split(".")[0] for point in points}))
        places = [Path(place) for spec in specs if spec for place in spec.submodule_search_locations or ()]
        offered = [place / "conf" for place in places if (place / "conf").is_dir()]
        return [config_dir(), *offered, *cls.own]

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Hydra's hook."""
        for folder in self.all()[1:]:
            search_path.append("hno", f"file://{folder.resolve()}")


def groups(name: str) -> list[str]:
    """Groups that a root configuration composes."""
    defaults: Any = OmegaConf.select(OmegaConf.load(config_dir() / f"{name}.yaml"), "defaults") or []
    return [str(group) for entry in defaults if OmegaConf.is_dict(entry) for group in entry]


def folders() -> set[str]:
    """Names of all groups that there are."""
    return {path.name for folder in Folders.all() for path in folder.iterdir() if path.is_dir()}


def choices(group: str) -> dict[str, Path | None]:
    """Choices of a group and their files; those of plugins without a file have none. Nothing is imported."""
    found: dict[str, Path | None] = {}
    if group in CHOSEN:
        found = {point.name: None for point in entry_points(group=f"hno.{plural(group)}")}
    files = (path for folder in Folders.all() for path in (folder / group).glob("*.yaml"))
    return dict(sorted({**found, **{path.stem: path for path in files}}.items()))


def register_plugins() -> None:
    """Make every registered name without a file a choice of its group, with its options and their defaults."""
    for group in CHOSEN:
        registry, have = REGISTRIES[group](), choices(group)
        for name in registry.names():
            if have.get(name) is None and (group, name) != ("operator", "gradient"):  # that of our own methods
                options = options_of(registry.get(name), skip=GIVEN.get(group, ()))
                node = _NODES.get(group, dict)({"name": name, **_writable(options)})
                package = "_global_" if group in _NODES else None
                ConfigStore.instance().store(group=group, name=name, node=node, package=package)


def _writable(options: Mapping[str, Any]) -> dict[str, Any]:
    """Defaults that yaml can hold; an option without a default must be given."""
    found = {name: "???" if value is inspect.Parameter.empty else value for name, value in options.items()}
    return {k: list(v) if isinstance(v, tuple) else v for k, v in found.items() if isinstance(v, _PLAIN)}


def _game(node: dict[str, Any]) -> dict[str, Any]:
    """A game with all constants that are numbers."""
    constants = {key: value for key, value in node.items() if type(value) in (int, float)}
    return {"game": {"name": node["name"], "constants": constants}}


def _method(node: dict[str, Any]) -> dict[str, Any]:
    """A method whose function is a plugin: the terms are those of `operator=hno`."""
    content = OmegaConf.to_container(OmegaConf.load(config_dir() / "operator" / "hno.yaml"))
    assert isinstance(content, dict)
    return {"operator": {"function": node["name"], **node}, "loss": content["loss"]}


_PLAIN = (bool, int, float, str, tuple, list, dict, type(None))
_NODES: Mapping[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    "game": _game,
    "operator": _method,
    "optimizer": lambda node: {"optimizer": {"lr": 3e-3, "schedule": "cosine", "final_lr": 3e-5, **node}},
}
"""Groups whose nodes are more than a name and options."""


def check_choices(name: str, overrides: Sequence[str]) -> None:
    """Refuse group choices that do not exist. Registries are imported for choices without a file only.

    Raises:
        UsageError: a choice does not exist; the message has the known ones and the nearest.
    """
    composed = groups(name)
    for override in overrides:
        match = re.fullmatch(r"\+*([a-z_]+)=([\w.,-]+)", override)
        if match is None or match[1] not in composed:
            continue
        group, known = match[1], choices(match[1])
        wanted = {choice for choice in match[2].split(",") if choice != "null" and known.get(choice) is None}
        if not wanted:
            continue
        register_plugins()
        names = {*known, *(REGISTRIES[group]().names() if group in CHOSEN else ())}
        for choice in sorted(wanted - names):
            raise UsageError(unknown_name(group, choice, sorted(names)))


def for_hydra(name: str, given: Arguments) -> list[str]:
    """Overrides as Hydra takes them, after the user's folder and the plugins are known to it.

    Raises:
        UsageError: a choice that does not exist, or a folder of configurations that does not.
    """
    folder = given.flags.get("--config-dir")
    if folder is not None and not Path(folder).is_dir():
        raise UsageError(f"--config-dir: there is no folder {folder}.")
    Folders.own = [] if folder is None else [Path(folder)]
    Plugins.instance().register(Folders)
    check_choices(name, given.overrides)
    composed, untouched = groups(name), folders()
    if "--multirun" in given.flags:
        untouched |= _swept(name, [override for override in given.overrides if override.startswith("experiment=")])
    return [rewritten(override, composed, untouched) for override in given.overrides]


def _swept(name: str, experiment: Sequence[str]) -> set[str]:
    """Keys that an experiment sweeps over: Hydra lets the command line narrow them under the same name only."""
    compose(name, experiment)
    return set(HydraConfig.get().sweeper.params or ())


def compose(name: str, overrides: Sequence[str]) -> DictConfig:
    """A configuration as Hydra composes it, without a job; interpolations that name `hydra` work."""
    try:
        with hydra.initialize_config_dir(str(config_dir()), version_base="1.3"):
            config = hydra.compose(name, overrides=list(overrides), return_hydra_config=True)
    except OverrideParseException as error:
        raise SettingsError(f"{error.override} cannot be read: {str(error).splitlines()[0]}.") from error
    HydraConfig.instance().set_config(config)
    OmegaConf.set_struct(config, False)
    del config["hydra"]
    return config


def read(model: type[S], config: DictConfig) -> S:
    """The composed configuration, judged by the schema of its command.

    Top-level entries that an experiment's file declares for its own interpolations are no part of it.

    Raises:
        SettingsError: see `hno.cli.schema.validated`.
    """
    hydra_config = HydraConfig.get()
    chosen = hydra_config.runtime.choices.get("experiment")
    files = [folder / "experiment" / f"{chosen}.yaml" for folder in Folders.all()]
    helpers = {key for file in files if file.exists() for key in OmegaConf.load(file)} - model.model_fields.keys()
    given = {override.partition("=")[0].lstrip("+~") for override in hydra_config.overrides.task}
    known = {key: value for key, value in _content(config).items() if key not in helpers and value != "???"}
    return validated(model, known, given)


def _content(config: DictConfig) -> dict[str, Any]:
    content = OmegaConf.to_container(config, resolve=True, throw_on_missing=False)
    assert isinstance(content, dict)
    return {str(key): value for key, value in content.items()}


def configured(name: str, model: type[S], given: Arguments) -> S | None:
    """The settings of a command without jobs; None after a dry run, which prints them.

    What a game's file says for other commands is left out.

    Raises:
        ValueError: a configuration that cannot be composed, or one that the schema refuses.
    """
    overrides = for_hydra(name, given)
    try:
        config = compose(name, overrides)
        chosen = [override for override in overrides if override.split("=")[0] in groups(name)]
        for key, value in _content(compose(name, chosen)).items():
            if key not in model.model_fields and _content(config)[key] == value:
                del config[key]
        settings = read(model, config)
    except (HydraException, OmegaConfBaseException) as error:
        raise SettingsError(str(error)) from error
    if "--dry-run" not in given.flags:
        return settings
    print(OmegaConf.to_yaml(OmegaConf.create(settings.model_dump())), end="")
    return None


def quoted(value: str) -> str:
    """A value that Hydra's grammar takes for one text, whatever is in it."""
    return "'" + re.sub(r"(\\*)'", r"\1\1\\'", value) + "'"


def under_hydra(name: str, job: Callable[[DictConfig], Any], words: Sequence[str]) -> None:
    """Let Hydra run jobs on a command line; its exceptions reach the caller, who says what they mean."""
    before = sys.argv
    sys.argv = [before[0], *words]
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        hydra.main(version_base="1.3", config_path=str(config_dir()), config_name=name)(job)()
    finally:
        sys.argv = before


def hydras_own(name: str, given: Arguments) -> int:
    """What Hydra does by itself: shell completion, and its help."""
    Plugins.instance().register(Folders)
    under_hydra(name, lambda config: None, [*given.hydra, *given.overrides])
    return 0
