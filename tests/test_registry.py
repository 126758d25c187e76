"""Registries find classes late and once, and say what they know when asked for what they do not."""

from __future__ import annotations

import importlib
import inspect
import os
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

import hno
from hno.cli.schema import REGISTRIES
from hno.data import make_sampler
from hno.games import make
from hno.operators import Architecture, make_operator
from hno.registry import BrokenPluginWarning, Registry, UnknownNameError, check_options, options_of

PACKAGE = """
from hno.registry import Registry

animals = Registry("animal", "zoo_for_tests")
"""
MODULE = """
from zoo_for_tests import animals


@animals.register("zebra")
class Zebra:
    pass


@animals.register("lion")
class Lion:
    pass
"""
PLUGIN = """
class Axolotl:
    "A salamander that stays young."
"""
GROUPS = {
    "game": "hno.games",
    "function": "hno.functions",
    "network": "hno.networks",
    "activation": "hno.activations",
    "loss": "hno.losses",
    "source": "hno.sources",
    "optimizer": "hno.optimizers",
    "callback": "hno.callbacks",
}
"""The entry-point group of every kind."""
NAMES = ("zoo_for_tests", "zoo_for_tests.savanna", "pond_for_tests")


class Metadata:
    """Entry points of installed packages, and how often they were asked for."""

    def __init__(self) -> None:
        self.points: list[EntryPoint] = []
        self.queries: list[str] = []

    def entry_points(self, *, group: str) -> list[EntryPoint]:
        self.queries.append(group)
        return [point for point in self.points if point.group == group]

    def install(self, name: str, target: str, group: str = "hno.animals") -> None:
        self.points.append(EntryPoint(name, f"pond_for_tests:{target}", group))


@pytest.fixture
def installed(monkeypatch) -> Metadata:
    metadata = Metadata()
    monkeypatch.setattr("hno.registry.entry_points", metadata.entry_points)
    return metadata


@pytest.fixture
def animals(tmp_path, monkeypatch, installed) -> Registry[object]:
    """A registry whose package has one module that nobody has imported yet."""
    package = tmp_path / "zoo_for_tests"
    package.mkdir()
    (package / "__init__.py").write_text(PACKAGE, encoding="utf-8")
    (package / "savanna.py").write_text(MODULE, encoding="utf-8")
    (tmp_path / "pond_for_tests.py").write_text(PLUGIN, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    for name in NAMES:
        monkeypatch.delitem(sys.modules, name, raising=False)
    yield importlib.import_module("zoo_for_tests").animals
    for name in NAMES:
        sys.modules.pop(name, None)


def test_modules_are_imported_on_the_first_look_up(animals):
    assert "zoo_for_tests.savanna" not in sys.modules
    assert animals.names() == ["lion", "zebra"]
    assert animals.get("zebra") is sys.modules["zoo_for_tests.savanna"].Zebra


def test_plugins_are_imported_on_the_first_look_up(animals, installed):
    installed.install("axolotl", "Axolotl")
    installed.install("other", "Axolotl", group="hno.plants")
    assert "pond_for_tests" not in sys.modules
    assert animals.get("axolotl").__name__ == "Axolotl"
    assert animals.names() == ["axolotl", "lion", "zebra"]


def test_discovery_happens_once(animals, installed):
    assert installed.queries == []
    animals.names()
    installed.install("axolotl", "Axolotl")
    with pytest.raises(UnknownNameError):
        animals.get("axolotl")
    assert animals.names() == ["lion", "zebra"]
    assert installed.queries == ["hno.animals"]


def test_registering_does_not_discover(animals, installed):
    animals.register("gnu")(type("Gnu", (), {}))
    assert installed.queries == []
    assert "zoo_for_tests.savanna" not in sys.modules
    assert animals.names() == ["gnu", "lion", "zebra"]


def test_an_unknown_name_is_answered_with_all_and_the_nearest(animals):
    with pytest.raises(UnknownNameError) as caught:
        animals.get("zebar")
    assert str(caught.value) == "No animal named 'zebar'. Known: lion, zebra. Did you mean 'zebra'?"


def test_no_guess_is_made_for_a_name_unlike_any(animals):
    with pytest.raises(UnknownNameError) as caught:
        animals.get("xyz")
    assert str(caught.value) == "No animal named 'xyz'. Known: lion, zebra."


def test_an_unknown_name_is_a_key_error(animals):
    with pytest.raises(KeyError):
        animals.get("xyz")


def test_a_taken_name_is_refused(animals):
    animals.names()
    with pytest.raises(ValueError, match=r"animal name 'lion' is taken by zoo_for_tests.savanna.Lion. Register .*Gnu"):
        animals.register("lion")(type("Gnu", (), {}))
    assert animals.get("lion").__name__ == "Lion"


def test_a_plugin_may_not_take_a_known_name(animals, installed):
    installed.install("lion", "Axolotl")
    with pytest.warns(BrokenPluginWarning, match=r"animal name 'lion' is taken by zoo_for_tests.savanna.Lion"):
        assert animals.names() == ["lion", "zebra"]
    assert animals.get("lion").__name__ == "Lion"


def test_what_cannot_be_loaded_is_named_and_stops_nothing_else(animals, installed, tmp_path):
    broken = tmp_path / "zoo_for_tests" / "aviary.py"
    broken.write_text("import nothing_of_that_name\n", encoding="utf-8")
    (tmp_path / "zoo_for_tests" / "basin.py").write_text("def (:\n", encoding="utf-8")
    installed.install("newt", "Newt")
    installed.install("axolotl", "Axolotl")
    with pytest.warns(BrokenPluginWarning) as caught:
        assert animals.names() == ["axolotl", "lion", "zebra"]
    assert len(caught) == 3
    assert all("so its animal is missing" in str(warning.message) for warning in caught)
    with pytest.raises(UnknownNameError) as error:
        animals.get("newt")
    said = str(error.value)
    assert said.startswith("No animal named 'newt'. Known: axolotl, lion, zebra. Could not be loaded: ")
    assert f"ModuleNotFoundError: No module named 'nothing_of_that_name' ({broken}:1)" in said
    assert "zoo_for_tests.basin: SyntaxError" in said
    assert "basin.py" in said
    assert 'newt = "pond_for_tests:Newt"' in said


def test_a_description_is_the_first_line_and_the_origin(animals, installed):
    installed.install("axolotl", "Axolotl")
    assert animals.describe("axolotl") == ("axolotl", "A salamander that stays young.", "pond_for_tests")
    assert animals.describe("lion") == ("lion", "", "zoo_for_tests.savanna")


def test_functions_are_registered_as_classes_are(animals):
    @animals.register("hatched")
    def hatch(eggs=3):
        """A clutch."""

    assert animals.get("hatched") is hatch
    assert animals.describe("hatched").summary == "A clutch."
    assert options_of(animals.get("hatched")) == {"eggs": 3}


def test_unknown_options_are_answered_with_the_known_ones_and_the_nearest():
    def hatch(nest, eggs=3, *others, warm=True, **more):
        pass

    assert options_of(hatch, skip=("nest",)) == {"eggs": 3, "warm": True}
    check_options("clutch", hatch, {"eggs": 4}, skip=("nest",))
    with pytest.raises(UnknownNameError) as caught:
        check_options("clutch", hatch, {"egs": 4}, skip=("nest",))
    assert str(caught.value) == "No option of clutch named 'egs'. Known: eggs, warm. Did you mean 'eggs'?"


@pytest.mark.parametrize(
    ("kind", "group"), [("game", "hno.games"), ("loss", "hno.losses"), ("activation", "hno.activations")]
)
def test_groups_of_entry_points_are_plurals(kind, group):
    assert Registry(kind, "zoo_for_tests").group == group


PROJECT = """
[build-system]
requires = ["setuptools"]
build-backend = "setuptools.build_meta"

[project]
name = "menagerie"
version = "0.3"

[tool.setuptools]
py-modules = ["menagerie"]
"""
MENAGERIE = """
class {name}(pkgutil.resolve_name({base!r})):
    "One of another package."
"""


def test_every_group_takes_an_installed_package(tmp_path):
    """One real package offers a class of every kind and is installed by pip; another interpreter looks them up."""
    source, site = tmp_path / "source", tmp_path / "site"
    source.mkdir()
    points = [
        f'[project.entry-points."{registry().group}"]\nforeign = "menagerie:{kind.title()}"'
        for kind, registry in REGISTRIES.items()
    ]
    (source / "pyproject.toml").write_text(PROJECT + "\n".join(points), encoding="utf-8")
    bases = {kind: registry().base or "builtins:object" for kind, registry in REGISTRIES.items()}
    classes = [MENAGERIE.format(name=kind.title(), base=base) for kind, base in bases.items()]
    (source / "menagerie.py").write_text("\n".join(["import pkgutil", *classes]), encoding="utf-8")
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--no-build-isolation"]
    subprocess.run([*pip, "--target", site, source], check=True, capture_output=True, text=True)
    path = os.pathsep.join([str(site), str(Path(hno.__file__).parent.parent)])
    code = (
        "from hno.cli.schema import REGISTRIES\n"
        "for kind, registry in REGISTRIES.items():\n"
        "    print(kind, *registry().describe('foreign'), registry().group, sep='|')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        f"{kind}|foreign|One of another package.|menagerie 0.3|{group}" for kind, group in GROUPS.items()
    ]


def test_registering_a_class_twice_is_harmless(animals):
    lion = animals.get("lion")
    assert animals.register("lion")(lion) is lion


def test_classes_know_their_names(animals):
    assert animals.name_of(animals.get("zebra")) == "zebra"
    with pytest.raises(UnknownNameError, match=r"Gnu is not a registered animal. Known: lion, zebra"):
        animals.name_of(type("Gnu", (), {}))


@pytest.mark.parametrize(
    ("module", "name", "known"),
    [
        ("hno.games", "games", {"drone", "lane_change", "narrow_road"}),
        ("hno.losses", "losses", {"boundary", "branches", "costate", "residual", "value"}),
        ("hno.operators", "functions", {"potential", "value"}),
        ("hno.operators", "networks", {"deeponet"}),
        ("hno.operators", "activations", {"relu", "sin", "tanh"}),
        ("hno.data", "sources", {"band", "box", "labels", "rollout"}),
        ("hno.training.optimizers", "optimizers", {"adam", "adamw", "muon", "soap"}),
    ],
)
def test_the_package_registers_what_it_ships(module, name, known):
    assert known <= set(getattr(importlib.import_module(module), name).names())


class Kettle:
    def __init__(self, litres: float, whistle: bool = True) -> None:
        self.litres, self.whistle = litres, whistle


def test_options_are_the_arguments_and_their_defaults():
    assert options_of(Kettle) == {"litres": inspect.Parameter.empty, "whistle": True}
    assert options_of(Kettle, skip=("litres",)) == {"whistle": True}


def test_an_unknown_option_comes_with_the_known_ones_and_the_nearest():
    check_options("kettle", Kettle, ["whistle", "litres"])
    with pytest.raises(UnknownNameError, match=r"No option of kettle named 'whistel'\. Known: litres, whistle\. Did"):
        check_options("kettle", Kettle, ["litres", "whistel"])
    with pytest.raises(UnknownNameError, match=r"Known: whistle\.$"):
        check_options("kettle", Kettle, ["litres"], skip=("litres",))
    with pytest.raises(UnknownNameError, match=r"Known: none\.$"):
        check_options("box", lambda: None, ["x"])


@pytest.mark.parametrize(
    ("part", "options"),
    [("function", ("game", "network")), ("network", ("inputs", "activation")), ("activation", ())],
)
def test_an_operator_refuses_options_that_its_parts_do_not_know(part, options):
    for option in ("widht", *options):
        wrong = replace(Architecture(), **{part: replace(getattr(Architecture(), part), options={option: 1})})
        with pytest.raises(UnknownNameError, match=rf"No option of {part} \w+ named '{option}'\. Known: "):
            make_operator(make("narrow_road"), wrong)


@pytest.mark.parametrize("name", ["box", "band", "labels", "rollout"])
def test_a_source_refuses_options_that_it_does_not_know(name):
    with pytest.raises(UnknownNameError, match=f"No option of source {name} named 'raech'. Known: "):
        make_sampler({name: {"share": 1.0, "raech": 2.0}})
    with pytest.raises(UnknownNameError, match=r"No source named 'bix'\. Known: band, box, .*Did you mean 'box'"):
        make_sampler({"bix": 1.0, name: 1.0})
