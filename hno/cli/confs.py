"""Folders of configuration files: ours, those of installed packages, the user's; and what can be chosen in them."""

from __future__ import annotations

import functools
import importlib.util
import re
import sys
from collections.abc import Iterator, Sequence
from importlib.metadata import EntryPoint, EntryPoints, entry_points
from pathlib import Path
from typing import Any, NamedTuple

from hydra.core.config_search_path import ConfigSearchPath
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import OmegaConf

import hno
from hno.registry import origin_of, plural

CHOSEN = ("game", "function", "network", "activation", "optimizer")
"""Groups whose choices are registered; methods of `operator` are files, its functions become methods."""
GROUP = "hno.confs"
"""Entry points of packages that bring configuration: "my_package.conf" is the folder conf in my_package."""
OWN = "--config-dir"
"""Where the user's folder comes from."""


class Conf(NamedTuple):
    """A folder of configuration files."""

    folder: Path
    origin: str
    """The distribution that it comes from, with its version, or what named it."""


def config_dir() -> Path:
    """The folder `conf`: inside an installed package, beside the package in a checkout."""
    package = Path(hno.__file__).parent
    found = next((folder for folder in (package / "conf", package.parent / "conf") if folder.is_dir()), None)
    if found is None:
        raise FileNotFoundError(f"The configuration folder conf/ is missing beside {package}. Install hno again.")
    return found


@functools.lru_cache(maxsize=1)
def _entry_points(path: tuple[str, ...]) -> Any:
    """All of the process, which takes 20 ms and is asked for a hundred times."""
    return entry_points()


def offered(kind: str) -> EntryPoints:
    """What installed packages offer of a kind; nothing is imported."""
    found: EntryPoints = _entry_points(tuple(sys.path)).select(group=f"hno.{plural(kind)}")
    return found


class Folders(SearchPathPlugin):
    """Folders of configuration files besides our own, for Hydra: those of packages, and --config-dir."""

    own: Sequence[Path] = ()
    """The user's."""

    @classmethod
    def all(cls) -> list[Conf]:
        """Every folder, ours first: of files with one name, the first one counts."""
        found, _ = _of_packages()
        return [Conf(config_dir(), "hno"), *found, *(Conf(folder, OWN) for folder in cls.own)]

    @classmethod
    def broken(cls) -> dict[str, str]:
        """Folders that packages offer and do not have, with the reason."""
        return _of_packages()[1]

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Hydra's hook."""
        for folder, _ in self.all()[1:]:
            search_path.append("hno", f"file://{folder.resolve()}")


def _of_packages() -> tuple[list[Conf], dict[str, str]]:
    found, broken = list[Conf](), dict[str, str]()
    for point in offered("conf"):
        try:
            found.append(Conf(_place(point), origin_of(point)))
        except (ImportError, ValueError) as error:
            broken[f'{point.name} = "{point.value}" of {origin_of(point)}'] = str(error)
    return found, broken


def _place(point: EntryPoint) -> Path:
    """The folder that an entry point names. Its package is looked up, and not imported.

    Raises:
        ImportError: there is no such package.
        ValueError: it has no such folder, or no files of configuration are in it.
    """
    package, *rest = re.split(r"[.:]", point.value.strip())
    spec = importlib.util.find_spec(package) if package.isidentifier() else None
    if spec is None or spec.submodule_search_locations is None:
        raise ImportError(f"there is no package {package}; expected <package>.<folder>, such as my_package.conf")
    folders = [Path(place, *rest) for place in spec.submodule_search_locations]
    folder = next((folder for folder in folders if folder.is_dir()), None)
    if folder is None:
        raise ValueError(f"there is no folder {folders[0]}; perhaps the package is built without its data files")
    if not any(folder.glob("*/*.yaml")):
        raise ValueError(f"{folder} holds no <group>/<name>.yaml; perhaps the package is built without its data files")
    return folder


def groups(name: str) -> list[str]:
    """Groups that a root configuration composes."""
    defaults: Any = OmegaConf.select(OmegaConf.load(config_dir() / f"{name}.yaml"), "defaults") or []
    return [str(group) for entry in defaults if OmegaConf.is_dict(entry) for group in entry]


def files(group: str) -> dict[str, tuple[Path, str]]:
    """Choices of a group that are files, with where they come from."""
    found = [(path, origin) for folder, origin in Folders.all() for path in sorted((folder / group).glob("*.yaml"))]
    return {path.stem: (path, origin) for path, origin in reversed(found)}


def choices(group: str) -> dict[str, Path | None]:
    """Choices of a group and their files; those of plugins without a file have none. Nothing is imported."""
    found: dict[str, Path | None] = {point.name: None for point in offered(group)} if group in CHOSEN else {}
    return dict(sorted({**found, **{name: path for name, (path, _) in files(group).items()}}.items()))


def hidden() -> Iterator[tuple[Path, str, str]]:
    """Files that one of the same name keeps from being chosen, where they come from, and where that one does."""
    seen = dict[Path, str]()
    for folder, origin in Folders.all():
        for path in sorted(folder.rglob("*.yaml")):
            name = path.relative_to(folder)
            if name in seen:
                yield path, origin, seen[name]
            seen.setdefault(name, origin)
