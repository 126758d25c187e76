"""Exported controllers as files: whole or not at all, damage is found, and what cannot be exported is named."""

from __future__ import annotations

import copy
import importlib.util
import json
import os
import py_compile
import random
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from hno_examples.three_walkers import ThreeWalkers
from torch import Tensor

import hno
from hno.cli.main import main
from hno.control import Feedback
from hno.control.rollout import rollout
from hno.export import ExportError, UnsupportedError, export, write
from hno.export.numpy_source import FORMS
from hno.games import make
from hno.operators import Architecture, Choice, make_operator
from hno.runtime import ArtefactError, load, signed
from hno.runtime.artefact import ENTRIES
from hno.training.checkpoint import Provenance, record
from hno.training.saving import seal
from tests.conftest import TEST
from tests.export.conftest import apart, operator_of

CASE = "narrow_road potential sin 1"
SMALL = Architecture(Choice("potential"), Choice("deeponet", {"width": 8, "depth": 2}))
pytestmark = pytest.mark.usefixtures("exported")  # what was traced once is not traced again


@pytest.fixture
def copied(exported, tmp_path: Path) -> Path:
    skipped = shutil.ignore_patterns("__pycache__")
    return Path(shutil.copytree(exported(CASE, "numpy"), tmp_path / "copied", ignore=skipped))


@pytest.mark.parametrize("kind", ["numpy", "c"])
def test_rollouts_of_the_exported_controller_are_those_of_the_policy(exported, kind: str) -> None:
    policy, own = Feedback(operator_of(CASE)), hno.load_exported(exported(CASE, kind))
    game = policy.game
    starts = game.initial_box.sample(12, torch.Generator().manual_seed(0))
    played, again = (rollout(game, player, starts, [1.5, 4.0], dt=0.1) for player in (policy, own))
    torch.testing.assert_close(again.x, played.x, atol=2e-3, rtol=1e-4)
    torch.testing.assert_close(own.value(1.0, starts, [1.0, 1.0]), policy.value(1.0, starts, [1.0, 1.0]))


def test_what_was_verified_is_what_runs(copied: Path) -> None:
    """Python would rather run a compiled file beside the source, if that says the source's size and time."""
    source, forged = copied / "controller.py", copied / "forged.py"
    stamp = source.stat()
    forged.write_text("raise AssertionError('this was never verified')".ljust(stamp.st_size))
    os.utime(forged, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    py_compile.compile(str(forged), importlib.util.cache_from_source(str(source)))
    forged.unlink()
    before = sorted(copied.rglob("*"))
    with pytest.raises(AssertionError, match="never verified"):
        imported_as_usual(source)
    assert load(copied)
    assert sorted(copied.rglob("*")) == before


def imported_as_usual(source: Path) -> None:
    """The usual way to import a file."""
    spec = importlib.util.spec_from_file_location("usual", source)
    assert spec is not None
    assert spec.loader is not None
    spec.loader.exec_module(importlib.util.module_from_spec(spec))


def test_every_flipped_byte_is_found(copied: Path) -> None:
    draw = random.Random(0)
    for file in sorted(copied.iterdir()):
        whole = file.read_bytes()
        for place in draw.sample(range(len(whole)), 50):
            file.write_bytes(whole[:place] + bytes([whole[place] ^ 1 << draw.randrange(8)]) + whole[place + 1 :])
            with pytest.raises(ArtefactError, match=file.name):
                load(copied)
        file.write_bytes(whole[: len(whole) // 2])
        with pytest.raises(ArtefactError, match=file.name):
            load(copied)
        file.write_bytes(whole)
    assert load(copied)


def test_other_versions_kinds_and_games_are_refused(copied: Path) -> None:
    def changed(**entries: object) -> Path:
        (copied / "manifest.json").write_text(signed(about | entries))
        return copied

    about = json.loads((copied / "manifest.json").read_text())
    with pytest.raises(ArtefactError, match="format 9"):
        hno.load_exported(changed(format=9))
    with pytest.raises(ArtefactError, match="kind 'fortran'"):
        hno.load_exported(changed(kind="fortran"))
    with pytest.raises(ArtefactError, match="another game"):
        hno.load_exported(changed(constants={"radius": 2.0}))
    with pytest.raises(ArtefactError, match="another game"):
        hno.load_exported(changed(game="lane_change"))
    with pytest.raises(ArtefactError, match="no exported controller"):
        hno.load_exported(copied / "nowhere")


def test_a_manifest_that_hno_did_not_write_is_refused(copied: Path) -> None:
    about = json.loads((copied / "manifest.json").read_text())
    for name in ENTRIES:
        for junk in ({}, {name: None}, {name: {} if ENTRIES[name] is list else []}):
            forged = {key: entry for key, entry in about.items() if key != name} | junk
            (copied / "manifest.json").write_text(signed(forged))
            with pytest.raises(ArtefactError, match=name):
                load(copied)
    (copied / "manifest.json").write_text(signed(about | {"files": {"../elsewhere": "0"}}))
    with pytest.raises(ArtefactError, match="no name of a file"):
        load(copied)


def test_a_missing_compiler_is_named(exported, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ArtefactError, match="no compiler: none of cc, gcc, clang"):
        load(exported(CASE, "c"))


def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ExportError, match=r"needs the package onnx: pip install 'hno\[export\]'"):
        export(operator_of(CASE), "onnx", tmp_path / "new")


class Odd(ThreeWalkers):
    """A game with an operation that no language has."""

    def sensors(self, theta: Tensor) -> Tensor:
        return torch.erfinv(super().sensors(theta) / 2)


def test_a_game_with_another_operation_is_refused_by_its_name(tmp_path: Path) -> None:
    with pytest.raises(UnsupportedError, match=r"aten\.erfinv\.default cannot be exported"):
        export(make_operator(Odd(), SMALL), "numpy", tmp_path / "new")
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_written_where_the_answers_differ(exported, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(FORMS, "sub", "({0} - 1.0001 * {1})")
    with pytest.raises(ExportError, match="differs from the operator by"):
        export(operator_of(CASE), "numpy", tmp_path / "new")
    assert list(tmp_path.iterdir()) == []


def test_an_earlier_export_is_replaced_and_nothing_else(exported, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.txt").write_text("mine")
    with pytest.raises(ExportError, match="something else"):
        export(operator_of(CASE), "numpy", other)
    with pytest.raises(ExportError, match="numpy, c, onnx, torch"):
        export(operator_of(CASE), "cobol", tmp_path / "new")
    assert [path.name for path in tmp_path.iterdir()] == ["other"]
    export(operator_of(CASE), "numpy", tmp_path / "new")
    Feedback(operator_of(CASE)).export("torch", tmp_path / "new")
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == [
        "control.pt2", "controller.pt2", "manifest.json", "prepare.pt2"
    ]  # fmt: skip
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new", "other"]


def test_a_controller_that_is_not_the_operator_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    changed, written = copy.deepcopy(operator_of(CASE)), write.KINDS["numpy"]
    with torch.no_grad():
        next(changed.parameters()).mul_(1.001)
    with monkeypatch.context() as patch:
        patch.setitem(write.KINDS, "numpy", lambda operator, about: written(write.in_double(operator_of(CASE)), about))
        with pytest.raises(ExportError, match=r"it differs from the operator by .*1e-05 are allowed"):
            export(changed, "numpy", tmp_path / "new")
    monkeypatch.setattr(write, "SILENT", 0.0)
    with pytest.raises(ExportError, match=r"of the questions say nothing \(0% are allowed\)"):
        export(operator_of(CASE), "numpy", tmp_path / "new")
    assert not list(tmp_path.iterdir())


def test_an_operator_whose_branches_tie_says_too_little_to_be_checked(tmp_path: Path) -> None:
    torch.manual_seed(0)
    with pytest.raises(ExportError, match=r"2\d\.\d% of the questions say nothing \(10% are allowed\)"):
        export(make_operator(make("narrow_road"), SMALL).requires_grad_(False), "numpy", tmp_path / "new")
    assert not list(tmp_path.iterdir())


def test_a_checkpoint_is_exported_and_evaluated(tmp_path: Path, capsys: pytest.CaptureFixture[str], cache) -> None:
    torch.manual_seed(0)
    game = make("narrow_road")
    kept = record(game, SMALL, Provenance("sno", [(1.0, 1.0)], 3))
    weights = {f"operator.{name}": weight for name, weight in apart(make_operator(game, SMALL)).state_dict().items()}
    (tmp_path / "best.ckpt").write_bytes(seal({"state_dict": weights, **kept}))
    assert main(["export", str(tmp_path), "--to", "numpy"]) == 0
    folder = Path(capsys.readouterr().out.strip())
    assert folder == tmp_path / "exported/numpy"
    policy = hno.load_exported(folder)
    assert policy.names() == {
        "game": "narrow_road", "operator": "sno", "function": "potential", "activation": "sin"
    }  # fmt: skip
    assert policy.types == [(1.0, 1.0)]
    options = {"theta": "1,1", "starts": TEST.starts, "seed": TEST.seed, "dt": 0.1}
    exported, own = (hno.evaluate(path, settings=options)["table"] for path in (folder, tmp_path / "best.ckpt"))
    assert exported[0]["collisions"] == own[0]["collisions"]
    with pytest.raises(ValueError, match="name its checkpoint"):
        hno.evaluate(folder, settings={"ntk": True, **options})
    assert exported[0]["value_error"] == pytest.approx(own[0]["value_error"], rel=1e-4)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["export"], "Usage: hno export"),
        (["export", "somewhere"], "Usage: hno export"),
        (["export", "somewhere", "--to", "cobol"], "--to is one of numpy"),
    ],
)
def test_the_command_refuses(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 2
    assert message in capsys.readouterr().err


def test_the_runtime_imports_numpy_alone() -> None:
    """How long that takes is in benchmarks/latency.py."""
    program = "import sys, numpy\nbefore = set(sys.modules)\nimport hno.runtime\nprint(*set(sys.modules) - before)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    packages = {name.partition(".")[0] for name in done.stdout.split()} - set(sys.stdlib_module_names)
    assert packages == {"hno"}
