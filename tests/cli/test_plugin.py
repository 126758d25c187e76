from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import EntryPoint
from typing import Any, ClassVar

import pytest
import torch

import hno
from hno import registry
from hno.games import Game, games
from hno.games.testing import check_game
from hno.losses.supervised import ValueDeviation
from hno.operators import activations, operators
from hno.operators.activations import Activation
from hno.operators.base import ValueOperator
from hno.types import Status
from tests.cli.conftest import SMOKE, Command
from tests.walkers import Walkers


@pytest.fixture(autouse=True)
def registries_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test registers is forgotten after it."""
    for known in (games, operators, activations):
        known.names()
        monkeypatch.setattr(known, "_classes", dict(known._classes))


@pytest.fixture
def entry_point(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Another installed package offers the game; nothing has been looked up yet."""
    offered = EntryPoint("pedestrians", "tests.walkers:Walkers", "hno.games")
    monkeypatch.setattr(registry, "entry_points", lambda group: [offered] if group == "hno.games" else [])
    monkeypatch.setattr(games, "_discovered", False)
    yield
    games._discovered = True


def test_the_game_keeps_the_contract_and_can_be_solved() -> None:
    game = Walkers()
    check_game(game)
    x0 = game.initial_box.sample(2, torch.Generator().manual_seed(0))
    found = hno.solve(game, x0, torch.ones(2, 2))
    assert found.status.tolist() == [Status.CONVERGED] * 2


@pytest.mark.parametrize("operator", ["hno", "sno"])
def test_a_game_registered_in_a_test_trains_without_touching_the_core(command: Command, operator: str) -> None:
    games.register("walkers")(Walkers)
    run = command("train", *SMOKE, "game=walkers", f"operator={operator}", "trainer.max_steps=4")
    assert run.code == 0, run.text
    assert run.results["game"] == "walkers"
    assert run.results["table"][0]["starts"] == 4
    policy = hno.load_policy(run.folder / "last.ckpt")
    assert isinstance(policy.game, Walkers)
    again = command("evaluate", f"checkpoint={run.folder}/last.ckpt", "theta=1,1", "workers=1", "starts=4", "dt=0.1")
    assert again.code == 0, again.text
    assert again.results["table"] == run.results["table"]


@pytest.mark.usefixtures("entry_point")
def test_a_game_of_another_package_trains_by_its_entry_point(command: Command) -> None:
    run = command("train", *SMOKE, "game=pedestrians", "trainer.max_steps=2")
    assert run.code == 0, run.text
    assert run.results["game"] == "pedestrians"
    refused = command("train", *SMOKE, "game=pedestrian")
    assert "Did you mean 'pedestrians'?" in refused.text


def test_constants_of_a_registered_game(command: Command) -> None:
    games.register("walkers")(Walkers)
    run = command("train", *SMOKE, "game=walkers", "+game.constants.radius=0.3", "trainer.max_steps=1")
    assert run.code == 0, run.text
    assert hno.load_policy(run.folder / "last.ckpt").game.radius == 0.3


def test_default_types_stay_within_the_game(command: Command) -> None:
    games.register("walkers")(Walkers)
    run = command("train", *SMOKE, "game=walkers", "trainer.max_steps=1")
    again = command("evaluate", f"checkpoint={run.folder}/last.ckpt", "workers=1", "starts=1", "dt=0.1")
    assert [row["theta"] for row in again.results["table"]] == [[1, 1], [1, 2], [2, 2], [2, 4]]


def test_operator_and_activation_registered_in_a_test(command: Command) -> None:
    @activations.register("softsign")
    class Softsign(Activation):
        @staticmethod
        def core(u: torch.Tensor) -> torch.Tensor:
            return torch.nn.functional.softsign(u)

        @staticmethod
        def core_and_first_(u: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            core = torch.nn.functional.softsign(u)
            return core, (1 - core.abs()) ** 2

        @staticmethod
        def times_second_(x: torch.Tensor, core: torch.Tensor, first: torch.Tensor) -> torch.Tensor:
            return x.mul_(-2 * core.sign() * (1 - core.abs()) * first)

        def init_(self, layer: torch.nn.Linear, *, first: bool) -> None:
            torch.nn.init.xavier_normal_(layer.weight)

    @operators.register("values_only")
    class ValuesOnly(ValueOperator):
        terms: ClassVar = {"value": ValueDeviation}

        def __init__(self, game: Game, activation: str = "tanh", **options: Any) -> None:
            assert "members" not in options
            super().__init__(game, activation, **options)

    run = command("train", *SMOKE, "operator=values_only", "activation=softsign", "trainer.max_steps=2")
    assert run.code == 0, run.text
    assert hno.load_policy(run.folder / "last.ckpt").operator.names()["activation"] == "softsign"
