"""The command line as a user meets it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import hno
from hno.cli.main import COMMANDS, main
from tests.cli.conftest import SMOKE, Command

ROOT = Path(__file__).parents[2]
HEAVY = "import sys; heavy = {'torch', 'lightning', 'scipy', 'matplotlib', 'wandb'} & set(sys.modules)"


def python(*words: str, path: tuple[Path, ...] = (), folder: Path = ROOT) -> str:
    """What another interpreter prints."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (*path, ROOT))), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_importing_the_package_imports_nothing_heavy_before_a_name_is_used() -> None:
    code = f"import hno; {HEAVY}; assert not heavy, heavy; hno.games; assert 'torch' in sys.modules; print(dir(hno))"
    assert "load_policy" in python("-c", code)


@pytest.mark.parametrize("name", hno.__all__)
def test_every_public_name_is_there(name: str) -> None:
    assert getattr(hno, name) is not None


def test_an_unknown_public_name_is_an_attribute_error_with_the_known_ones() -> None:
    with pytest.raises(AttributeError, match=r"module 'hno' has no attribute 'slove'; it offers .*solve"):
        _ = hno.slove


@pytest.mark.parametrize("words", [("--version",), ("--help",), *((name, "--help") for name in COMMANDS)], ids=" ".join)
def test_help_and_version_import_nothing_heavy(words: tuple[str, ...]) -> None:
    code = f"from hno.cli.main import main; assert main({list(words)!r}) == 0; {HEAVY}; assert not heavy, heavy"
    printed = python("-c", code)
    assert printed == f"hno {hno.__version__}\n" if "--version" in words else printed.startswith("Usage: hno")


def test_completion_imports_nothing_heavy(monkeypatch: pytest.MonkeyPatch) -> None:
    line = "train.py optimizer="
    monkeypatch.setenv("COMP_LINE", line)
    monkeypatch.setenv("COMP_POINT", str(len(line)))
    code = f"from hno.cli.main import main; main(['train', '-sc', 'query=bash']); {HEAVY}; assert not heavy, heavy"
    assert python("-c", code).split() == [f"optimizer={name}" for name in ("adam", "adamw", "muon", "soap")]


@pytest.mark.parametrize("file", ["train.py", "evaluate.py"])
def test_the_scripts_are_the_commands(file: str) -> None:
    assert python(file, "--version") == f"hno {hno.__version__}\n"
    assert python(file, "--help").startswith(f"Usage: python {file} ")


def test_help_shows_groups_that_can_be_chosen_and_keys_with_their_comments(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["train", "game=drone", "--help"]) == 0
    printed = capsys.readouterr().out
    groups = printed[printed.index("Groups") : printed.index("Keys")]
    for part in (
        "* drone ",
        " narrow_road ",
        "* sno ",
        " hno ",
        "* soap ",
        "* auto ",
        " potential ",
        "* deeponet ",
        " fast ",
    ):
        assert part in groups
    keys = yaml.safe_load(printed[printed.index("\n", printed.index("Keys")) :])
    assert keys["data"]["types"] == "grid5"
    (line,) = [line for line in printed.splitlines() if "precondition_frequency" in line or "pretrain:" in line][:1]
    assert "# share of the steps that are supervised only" in line


def test_an_unknown_command_or_flag_is_answered_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trian"]) == 2
    assert "Did you mean 'train'?" in capsys.readouterr().err
    assert main(["list", "--to", "x"]) == 2
    assert "hno list takes no --to; its flags are --help" in capsys.readouterr().err


def test_a_dry_run_prints_the_settings_and_leaves_nothing(command: Command, no_labels: None) -> None:
    run = command("train", *SMOKE, "game.constants.radius=1.5", "sampler.band=0.1", "--dry-run")
    assert run.code == 0, run.text
    settings = yaml.safe_load(run.text)
    assert settings["game"] == {"name": "narrow_road", "constants": {"radius": 1.5}}
    assert settings["sampler"]["band"] == {"share": 0.1, "reach": 1.5}
    assert not run.folder.exists()


def test_a_dry_multirun_prints_its_jobs(command: Command, no_labels: None, tmp_path: Path) -> None:
    words = ("activation=sin,tanh", "operator=hno,sno", "loss.weights.residual=0.1", "-m", "experiment=smoke")
    run = command("train", *words, "--dry-run", f"hydra.sweep.dir={tmp_path}/sweep")
    assert run.code == 1
    lines = run.text.splitlines()
    assert [line.split()[:3] for line in lines if line[0].isdigit() and ":" in line] == [
        [f"{number}:", f"activation={activation}", f"operator={operator}"]
        for number, (activation, operator) in enumerate((a, o) for a in ("sin", "tanh") for o in ("hno", "sno"))
    ]
    assert lines[-1] == "4 jobs, 2 refused"
    assert run.text.count("refused: Every loss term needs a weight") == 2
    assert not (tmp_path / "sweep").exists()


def test_to_is_the_output_folder(command: Command, tmp_path: Path) -> None:
    folder = tmp_path / "one, two"
    assert main(["train", *SMOKE, "trainer.max_steps=1", "--to", str(folder)]) == 0
    assert (folder / "results.json").exists()


@pytest.mark.parametrize("words", ["--help", "train --help"])
def test_help_whose_reader_has_gone_is_no_traceback(words: str) -> None:
    command = f"{sys.executable} -m hno {words} | true"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, shell=True, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.stderr == ""


def test_a_mistake_of_ours_is_no_message(monkeypatch: pytest.MonkeyPatch) -> None:
    """A missing key somewhere in the package would else end as one quoted word."""

    def broken(given: object) -> int:
        raise KeyError("operator")

    monkeypatch.setattr("hno.cli.listing.run", broken)
    with pytest.raises(KeyError):
        main(["list"])
