"""What is learned: the potential where the game has one, the players' values elsewhere or if asked."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import hno
from hno.cli.calls import train_settings
from hno.games import games
from tests.cli.conftest import SMOKE, Command, Outcome, refused
from tests.walkers import Walkers


class Shared(Walkers):
    """The pedestrians as a potential game, which they are: both bear the same penalty."""

    potential = True


class Claimed(Shared):
    """One that says so wrongly."""

    def potential_cost(self, x: Tensor, theta: Tensor) -> Tensor:
        return self.penalty(x, theta).sum(-1)


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    games.names()
    found = {"walkers": Walkers, "shared": Shared, "claimed": Claimed, "built": lambda: Shared()}
    monkeypatch.setattr(games, "_classes", {**games._classes, **found})


@pytest.mark.parametrize(
    ("game", "function"),
    [
        *((game, "potential") for game in ("narrow_road", "lane_change", "drone", "intersection", "shared")),
        ("walkers", "value"),
        ("built", "potential"),
    ],
)
def test_auto_is_the_potential_of_a_game_that_has_one(game: str, function: str) -> None:
    chosen = train_settings([f"game={game}"]).function
    assert chosen == {"name": function, "exact_terminal": True, "members": 1}
    assert train_settings([f"game={game}", "function=auto"]).function == chosen


def test_options_of_auto_are_those_of_what_it_stands_for() -> None:
    for game, name in (("narrow_road", "potential"), ("walkers", "value")):
        given = [f"game={game}", "function.exact_terminal=false", "function.members=3"]
        assert train_settings(given).function == {"name": name, "exact_terminal": False, "members": 3}


@pytest.mark.parametrize("function", ["value", "potential"])
def test_the_games_own_choice_can_be_overruled(function: str) -> None:
    assert train_settings(["game=drone", f"function={function}"]).function["name"] == function


def test_both_functions_in_one_sweep(command: Command, tmp_path) -> None:
    sweep = f"hydra.sweep.dir={tmp_path}/sweep"
    run = command("train", "-m", sweep, *SMOKE, "trainer.max_steps=2", "function=value,potential")
    assert run.code == 0, run.text
    jobs = [Outcome(0, "", folder) for folder in sorted((tmp_path / "sweep").glob("*_narrow_road_hno_*_sin"))]
    assert [(job.results["status"], job.results["function"]) for job in jobs] == [
        ("finished", "value"), ("finished", "potential"),
    ]  # fmt: skip
    assert len({job.results["training_hash"] for job in jobs}) == 2
    policies = [hno.load_policy(job.folder / "last.ckpt") for job in jobs]
    assert [policy.names()["function"] for policy in policies] == ["value", "potential"]
    assert [policy.operator.potential for policy in policies] == [False, True]
    terms = [set(job.results["metrics"]) for job in jobs]
    assert terms[0] == terms[1] >= {"loss/branches", "loss/value", "loss/costate"}
    assert jobs[0].results["metrics"]["loss/branches"] == 0
    for policy in policies:
        x = policy.game.initial_box.sample(3, torch.Generator().manual_seed(0))
        assert policy.value(torch.full((3,), 3.0), x, torch.ones(3, 2)).shape == (3, 2)


@pytest.mark.usefixtures("no_labels")
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("game=walkers", "function=potential"), "Walkers does not say that it is one (`potential`)"),
        (("game=claimed",), "Claimed misses by "),
    ],
)
def test_a_game_that_is_no_potential_game_is_an_error_before_any_work(
    command: Command, words: tuple[str, ...], message: str
) -> None:
    for more in ((), ("--dry-run",)):
        run = command("train", *SMOKE, *words, *more)
        refused(run, message, "function=value")
        assert not run.folder.exists()


@pytest.mark.usefixtures("no_labels")
@pytest.mark.parametrize("key", ["function", "function.name"])
def test_a_misspelt_function_is_answered_with_the_known_ones(command: Command, key: str) -> None:
    known = "Known: auto, potential, value." if key == "function" else "Known: potential, value."
    refused(command("train", *SMOKE, f"{key}=potentail"), known, "Did you mean 'potential'?")


def test_a_potential_game_from_outside_trains_by_default(command: Command) -> None:
    run = command("train", *SMOKE, "game=shared", "trainer.max_steps=2")
    assert run.code == 0, run.text
    assert run.results["function"] == "potential"
    assert run.results["label_statistics"][0]["starts"] == 4
