"""Packages bring configuration of their own: `hno.confs`."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import tomllib
from pathlib import Path

import pytest
from omegaconf import OmegaConf

import hno
from hno.cli.confs import Folders, choices
from hno.cli.main import main
from hno.cli.schema import REGISTRIES
from tests.cli.conftest import Command, clean_globals, command, no_pages  # noqa: F401  # fixtures

ROOT = Path(hno.__file__).parents[1]
PACKAGE = ROOT / "examples" / "crossroads"
Printed = pytest.CaptureFixture[str]


def offer(site: Path, name: str, points: dict[str, dict[str, str]]) -> Path:
    """What pip leaves of a package besides its modules."""
    (info := site / f"{name.replace('-', '_')}-0.1.0.dist-info").mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1.0\n")
    lines = [f"[{group}]\n" + "\n".join(f"{k} = {v}" for k, v in entries.items()) for group, entries in points.items()]
    (info / "entry_points.txt").write_text("\n".join(lines))
    return site


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The package of the examples as pip leaves it, beside three whose configuration cannot be used."""
    project = tomllib.loads((PACKAGE / "pyproject.toml").read_text())["project"]
    site = offer(tmp_path / "site", project["name"], project["entry-points"])
    offer(site, "forgotten", {"hno.confs": {"forgotten": "forgotten.conf"}})
    (site / "forgotten").mkdir()
    offer(site, "absent", {"hno.confs": {"absent": "absent:conf"}})
    offer(site, "hiding", {"hno.confs": {"hiding": "hiding.conf"}})
    file = site / "hiding" / "conf" / "optimizer" / "adam.yaml"
    file.parent.mkdir(parents=True)
    file.write_text("# theirs\nname: adam\nlr: 7.0\n")
    for place in (site, PACKAGE):
        monkeypatch.syspath_prepend(place)
    for registry in (found() for found in REGISTRIES.values()):
        registry.names()
        for name in ("_classes", "_origins", "broken"):
            monkeypatch.setattr(registry, name, dict(getattr(registry, name)))
        monkeypatch.setattr(registry, "_discovered", False)
    return site


def test_a_package_is_listed_with_its_names_and_what_is_wrong_with_others(installed: Path, capsys: Printed) -> None:
    assert main(["list", "game", "loss", "method", "experiment", "optimizer"]) == 1
    found = capsys.readouterr()
    rows = {line.split()[0]: line for line in found.out.splitlines() if line.endswith("[hno-crossroads 0.1.0]")}
    assert sorted(rows) == ["crossroads", "turned"]
    assert found.out.count("[hno-crossroads 0.1.0]") == 4, "a game, a loss term, a method and an experiment"
    for said in (
        f'forgotten = "forgotten.conf" of forgotten 0.1.0: there is no folder {installed}/forgotten/conf; perhaps',
        'absent = "absent:conf" of absent 0.1.0: there is no package absent; expected <package>.<folder>',
        f"{installed}/hiding/conf/optimizer/adam.yaml of hiding 0.1.0: a file of hno has its name and counts",
    ):
        assert f"Could not be loaded: {said}" in found.err
    assert choices("optimizer")["adam"] == ROOT / "conf" / "optimizer" / "adam.yaml"


@pytest.mark.usefixtures("installed", "no_labels")
def test_what_it_brings_is_chosen_by_name(command: Command) -> None:  # noqa: F811
    with pytest.warns(UserWarning, match="forgotten.* cannot be used, so its choices are missing"):
        run = command("train", "experiment=crossroads", "--dry-run")
    assert run.code == 0, run.text
    chosen = OmegaConf.create(run.text)
    assert (chosen.game.name, chosen.operator.name, chosen.loss.weights.turned) == ("crossroads", "turned", 0.1)
    assert chosen.optimizer.name == "soap"
    with pytest.warns(UserWarning, match="absent"):
        refused = command("train", "experiment=crossroad", "--dry-run")
    assert refused.code == 2
    assert "Did you mean 'crossroads'?" in refused.text
    assert "Could not be loaded: forgotten" in refused.text, "it may have been one of those"


def test_without_it_nothing_is_there() -> None:
    assert [conf.origin for conf in Folders.all() if conf.origin.startswith("hno-crossroads")] == []
    assert "crossroads" not in choices("game")


def test_a_file_of_ones_own_that_would_not_count_is_refused(
    command: Command,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Folders, "own", [])  # as it was, afterwards
    (tmp_path / "mine" / "experiment").mkdir(parents=True)
    (tmp_path / "mine" / "experiment" / "smoke.yaml").write_text("seed: 7\n")
    run = command("train", "experiment=smoke", "--config-dir", str(tmp_path / "mine"), "--dry-run")
    assert run.code == 2
    assert (
        "experiment/smoke.yaml could not be chosen: hno has a file of that name, which counts. Rename it." in run.text
    )


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Python of an environment of its own that sees this one's packages; what is installed there stays there."""
    folder = tmp_path_factory.mktemp("environment")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    python = folder / "bin" / "python"
    ask = [python, "-c", "import sysconfig; print(sysconfig.get_paths()['purelib'])"]
    site = Path(subprocess.run(ask, check=True, capture_output=True, text=True).stdout.strip())
    (site / "ours.pth").write_text(f"{sysconfig.get_paths()['purelib']}\n{ROOT}\n")
    return python


@pytest.mark.slow
@pytest.mark.parametrize("how", ["plain", "editable"])
def test_it_is_installed_tested_listed_and_trained_under_every_launcher(
    elsewhere: Path, cache: Path, tmp_path: Path, how: str
) -> None:
    pip = [sys.executable, "-m", "pip", f"--python={elsewhere}", "install", "-q", "--no-deps", "--no-index"]
    pip += ["--no-build-isolation", "--force-reinstall"]
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"} | {"HNO_CACHE": str(cache)}

    def run(*words: str) -> str:
        done = subprocess.run(
            [elsewhere, "-m", *words], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    source = tmp_path / "source"
    subprocess.run(["cp", "-r", PACKAGE, source], check=True)
    subprocess.run([*pip, *(["-e"] if how == "editable" else []), source], check=True)
    run("pytest", "-q", str(source / "tests"))
    assert run("hno", "list").count("[hno-crossroads 0.1.0]") == 4
    assert "crossroads keeps the contract of a game: 4 players" in run("hno", "check-game", "crossroads")
    words = ("game=crossroads", "operator=turned", "experiment=smoke", "data.types=[[1,1,1,1]]", "evaluation.starts=1")
    small = ("data.trajectories=2", "trainer.max_steps=2", "data.workers=1", "evaluation.dt=0.25")
    for launcher in ("basic", "joblib"):
        sweep = ("-m", "seed=0,1", f"launcher={launcher}", "--to", launcher)
        assert run("hno", "train", *words, *small, *sweep).count(" finished") >= 2
