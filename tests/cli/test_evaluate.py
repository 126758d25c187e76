from __future__ import annotations

import itertools
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

import hno
from hno.cli.config import config_dir
from hno.cli.evaluate import types_to_evaluate
from hno.games.base import ExtrapolationWarning
from tests.cli.conftest import SMOKE, Command, refused

FAST = ("workers=1", "starts=4", "dt=0.1")


def test_evaluation_of_a_trained_model_repeats_the_table_of_its_run(command: Command, tmp_path: Path) -> None:
    trained = command("train", *SMOKE, "trainer.max_steps=5", folder=tmp_path / "train")
    before = {path: path.read_bytes() for path in trained.folder.iterdir() if path.is_file()}
    run = command("evaluate", f"checkpoint={trained.folder}/last.ckpt", "theta=1,1", *FAST, folder=tmp_path / "eval")
    assert run.code == 0, run.text
    results = run.results
    assert results["table"] == trained.results["table"]
    assert {name: results[name] for name in ("game", "operator", "activation", "status")} == {
        "game": "narrow_road", "operator": "hno", "activation": "tanh", "status": "finished",
    }  # fmt: skip
    assert "narrow_road / hno / tanh" in run.text
    assert {path: path.read_bytes() for path in before} == before


def test_types_from_the_command_line(command: Command, random_checkpoint: Path) -> None:
    run = command("evaluate", f"checkpoint={random_checkpoint}", "theta=1,1;2.5,4.1", *FAST)
    assert run.code == 0, run.text
    table = run.results["table"]
    assert [(row["theta"], row["seen"], row["starts"]) for row in table] == [([1, 1], True, 4), ([2.5, 4.1], False, 4)]
    assert "2.5, 4.1" in run.text


@pytest.mark.parametrize(("name", "size"), [("grid5", 5), ("grid9", 9)])
def test_named_grids_span_the_types_of_the_game(random_checkpoint: Path, name: str, size: int) -> None:
    policy = hno.load_policy(random_checkpoint)
    types = types_to_evaluate(name, policy)
    axis = torch.linspace(1, 5, size).tolist()
    assert types == [pytest.approx(theta) for theta in itertools.product(axis, axis)]


def test_default_types_are_the_seen_ones_and_four_unseen(random_checkpoint: Path) -> None:
    unseen = OmegaConf.load(config_dir() / "evaluate.yaml").unseen
    types = types_to_evaluate("default", hno.load_policy(random_checkpoint), unseen)
    assert types == [(1.0, 1.0), (1.0, 2.0), (2.0, 2.0), (2.0, 4.0), (4.0, 5.0)]


def test_types_outside_the_range_warn(random_checkpoint: Path) -> None:
    with pytest.warns(ExtrapolationWarning, match="extrapolate"):
        assert types_to_evaluate("6,1", hno.load_policy(random_checkpoint)) == [(6.0, 1.0)]


@pytest.mark.usefixtures("no_labels")
@pytest.mark.parametrize(
    ("theta", "message"),
    [
        ("everything", "default, grid5, grid9"),
        ("grid7", "grid5, grid9"),
        ("1,1;2", "2 finite numbers"),
        ("1", "2 finite numbers"),
        ("1,1,1", "2 finite numbers"),
        ("1,nan", "2 finite numbers"),
        ("1,inf", "2 finite numbers"),
        ("1,1;", "grid5, grid9"),
    ],
)
def test_impossible_types(command: Command, random_checkpoint: Path, theta: str, message: str) -> None:
    run = command("evaluate", f"checkpoint={random_checkpoint}", f"theta={theta}", *FAST)
    refused(run, message)
    assert run.results["status"] == "failed"


@pytest.mark.usefixtures("no_labels")
@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("starts=0", "starts must be"),
        ("starts=-4", "starts must be"),
        ("dt=0", "dt must be"),
        ("dt=5", "divides the horizon"),
        ("clearance=-1", "clearance must be"),
        ("clearance=nan", "clearance must be"),
        ("expected_game=drone", "of game 'narrow_road', expected 'drone'"),
        ("start=5", "Did you mean 'starts'?"),
        ("checkpoint=/nowhere/last.ckpt", "There is no checkpoint at /nowhere/last.ckpt"),
    ],
)
def test_impossible_settings(command: Command, random_checkpoint: Path, override: str, message: str) -> None:
    refused(command("evaluate", f"checkpoint={random_checkpoint}", *FAST, override), message)


@pytest.mark.usefixtures("no_labels")
def test_without_a_checkpoint(command: Command) -> None:
    refused(command("evaluate"), "checkpoint=<path")


@pytest.mark.usefixtures("no_labels")
@pytest.mark.parametrize("kept", [0.0, 0.5, 0.99])
def test_truncated_checkpoint(command: Command, random_checkpoint: Path, kept: float) -> None:
    content = random_checkpoint.read_bytes()
    random_checkpoint.write_bytes(content[: int(kept * len(content))])
    run = command("evaluate", f"checkpoint={random_checkpoint}")
    refused(run, "not a readable checkpoint")
    assert run.results["reason"].startswith("CheckpointError")


@pytest.mark.usefixtures("no_labels")
def test_unwritable_output_folder(command: Command, random_checkpoint: Path) -> None:
    run = command("evaluate", f"checkpoint={random_checkpoint}", folder=Path("/proc/nowhere"))
    refused(run, "output folder cannot be written", "/proc/nowhere")


def test_without_a_safe_start_the_rate_is_not_applicable(command: Command, random_checkpoint: Path) -> None:
    run = command("evaluate", f"checkpoint={random_checkpoint}", "theta=1,1", "clearance=50", *FAST)
    assert run.code == 0, run.text
    assert run.results["table"][0]["rate"] is None
    assert "n/a" in run.text
