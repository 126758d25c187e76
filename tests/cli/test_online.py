"""`python evaluate.py online=N`: the learned policy beside the game solved online."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from rich.console import Console

from hno.cli.sections import show_section
from hno.evaluation.online import Online
from hno.evaluation.sections import Evaluation
from hno.training.checkpoint import load_policy
from tests.cli.conftest import Command, refused
from tests.fakes import fake_labels

FAST = ("workers=1", "starts=4", "dt=0.1", "theta=1,1")


@pytest.mark.slow
def test_the_game_is_solved_online_beside_the_learned_policy(command: Command, random_checkpoint: Path) -> None:
    run = command("evaluate", f"checkpoint={random_checkpoint}", *FAST, "online=2", "online_interval=3")
    assert run.code == 0, run.text
    online = run.results["online"]
    assert (online["starts_per_type"], online["interval"], online["dt"], online["reason"]) == (2, 3, 0.1, None)
    one, total = online["table"]
    assert (one["theta"], total["theta"]) == ([1, 1], None)
    assert one["solver"] == total["solver"]
    assert (one["solver"]["safe_starts"], one["solver"]["collisions"]) == (2, 0)
    assert one["policy"]["collisions"] == 2, "random weights do not evade"
    assert one["solves"] == {"solves": 20, "searches": 0, "failures": 0}
    spent = online["latency"]
    assert spent["solver"]["answers"] == 2 * 9
    assert spent["policy"]["answers"] == 2 * 29
    assert spent["solver"]["rate"] == pytest.approx(1 / spent["solver"]["median"])
    assert "20 / 0 / 0" in run.text
    assert "every 300 ms" in run.text
    assert f"{spent['solver']['rate']:.1f} Hz" in run.text
    assert run.results["seconds"]["online"] > 0


def test_it_is_off_by_default(command: Command, random_checkpoint: Path) -> None:
    run = command("evaluate", f"checkpoint={random_checkpoint}", *FAST)
    assert "online" not in run.results
    assert "solved online" not in run.text


@pytest.mark.usefixtures("no_labels")
@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("online=-1", "online must be"),
        ("online=true", "online must be"),
        ("online_interval=0", "online_interval must be greater than or equal to 1; got 0"),
    ],
)
def test_impossible_settings(command: Command, random_checkpoint: Path, override: str, message: str) -> None:
    refused(command("evaluate", f"checkpoint={random_checkpoint}", *FAST, override), message)


def test_without_a_safe_start_nothing_is_played(random_checkpoint: Path, capsys: pytest.CaptureFixture[str]) -> None:
    policy = load_policy(random_checkpoint)
    found = fake_labels(policy.game, (1.0, 1.0), 3, clearance=[-1.0] * 3, start=torch.zeros(3, 2, 4))
    options, types = {"online": 2, "online_interval": 1, "clearance": 0.02, "dt": 0.1}, [(1.0, 1.0)]
    evaluation = Evaluation("any", policy, types, types, options, lambda condition: [found], [found])
    section = Online().compute(evaluation)
    assert (section["table"], section["latency"]) == ([], None)
    show_section("online", section, {}, Console())
    assert "n/a (no start has a safe equilibrium)" in capsys.readouterr().out
