from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from torch import Tensor, nn

import hno
from hno import registry
from hno.cli import launch
from hno.cli.calls import train_settings
from hno.cli.schema import REGISTRIES
from hno.data.sources import BoxSource, Known, Source
from hno.games import Game, games
from hno.games.testing import check_game
from hno.losses import LossTerm, View
from hno.operators import Network, ValueOperator
from hno.operators.activations import Activation
from hno.operators.gradient import GradientOperator
from hno.operators.network import Inputs
from hno.types import Field, Points, Status, Types
from tests.cli.conftest import SMOKE, Command
from tests.walkers import Walkers


@pytest.fixture(autouse=True)
def registries_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test registers is forgotten after it."""
    for known in (found() for found in REGISTRIES.values()):
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
    again = command("evaluate", f"checkpoint={run.folder}/last.ckpt", "theta=1,1", "workers=1", "starts=4", "dt=0.25")
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


@pytest.mark.slow
def test_default_types_stay_within_the_game(command: Command) -> None:
    games.register("walkers")(Walkers)
    run = command("train", *SMOKE, "game=walkers", "trainer.max_steps=1")
    again = command("evaluate", f"checkpoint={run.folder}/last.ckpt", "workers=1", "starts=1", "dt=0.25")
    assert [row["theta"] for row in again.results["table"]] == [[1, 1], [0, 1], [1, 3], [3, 4]]


class Softsign(Activation):
    """z / (1 + |z|)."""

    def __init__(self, sharpness: float = 1.0) -> None:
        super().__init__()
        self.sharpness = sharpness

    @staticmethod
    def core(u: Tensor) -> Tensor:
        return nn.functional.softsign(u)


class Shallow(Network):
    """One hidden layer."""

    def __init__(self, inputs: Inputs, activation: Callable[[], Activation], hidden: int = 8) -> None:
        super().__init__()
        self.first, self.act = nn.Linear(inputs.total + inputs.sensors, hidden), activation()
        self.last = nn.Linear(hidden, 1)

    def forward(self, y: Tensor, sensors: Tensor, which: Tensor) -> Tensor:
        return self.last(self.act(self.first(torch.cat([y, sensors[which]], -1)))).squeeze(-1)


class Wrapped(ValueOperator):
    """The operator of values in another class."""

    def __init__(self, game: Game, network: Callable[[Inputs], Network], exact_terminal: bool = True) -> None:
        super().__init__(game)
        self.inner = GradientOperator(game, network, exact_terminal)
        self.meets_terminal = exact_terminal

    def field(self, points: Points, types: Types | None = None) -> Field:
        return self.inner.field(points, types)

    def value(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        return self.inner.value(tau, x, theta)

    def value_and_costate(self, tau: Tensor, x: Tensor, theta: Tensor) -> tuple[Tensor, Tensor]:
        return self.inner.value_and_costate(tau, x, theta)


class Small(LossTerm):
    """Values near zero."""

    stream = "interior"

    def __init__(self, power: float = 1.0) -> None:
        super().__init__()
        self.power = power

    def residual(self, view: View) -> Tensor:
        return view.field.value.abs() ** self.power

    def scale(self, view: View) -> Tensor:
        return view.scales.value


class Early(Source):
    """Uniform states at the start of the game."""

    def __init__(self, share_of_horizon: float = 0.5) -> None:
        self.share = share_of_horizon

    def draw(self, game: Game, theta: Tensor, window: float, known: Known, generator: torch.Generator) -> Points:
        return BoxSource().draw(game, theta, window * self.share, known, generator)


def sgd(params: Iterable[nn.Parameter], lr: float, momentum: float = 0.5) -> torch.optim.Optimizer:
    """Gradient descent with momentum."""
    return torch.optim.SGD(params, lr=lr, momentum=momentum)


FOREIGN = {
    "activation": ("softsign", Softsign), "network": ("shallow", Shallow), "function": ("wrapped", Wrapped),
    "loss": ("small", Small), "source": ("early", Early), "optimizer": ("sgd", sgd),
}  # fmt: skip


@pytest.fixture
def foreign() -> None:
    """A class of every kind from outside the package."""
    for kind, (name, found) in FOREIGN.items():
        REGISTRIES[kind]().register(name)(found)


CHOSEN = (
    "activation=softsign", "network=shallow", "function=wrapped", "optimizer=sgd", "sampler.early=1",
    "loss.terms.small={}", "loss.weights.small=0.1", "trainer.max_steps=3", "data.pretrain=0", "data.finish=0",
)  # fmt: skip


@pytest.mark.usefixtures("foreign")
def test_a_part_of_every_kind_from_outside_trains_with_its_defaults(command: Command) -> None:
    run = command("train", *SMOKE, *CHOSEN)
    assert run.code == 0, run.text
    assert run.results["metrics"]["loss/small"] > 0
    found = run.results["config"]
    assert found["activation"] == {"name": "softsign", "sharpness": 1.0}
    assert found["network"] == {"name": "shallow", "hidden": 8}
    assert found["function"] == {"name": "wrapped", "exact_terminal": True}
    assert found["loss"]["terms"]["small"] == {"power": 1.0}
    assert found["sampler"]["early"] == {"share": 1, "share_of_horizon": 0.5}
    assert (found["optimizer"]["name"], found["optimizer"]["momentum"]) == ("sgd", 0.5)
    assert hno.load_policy(run.folder / "last.ckpt").names()["function"] == "wrapped"


@pytest.mark.usefixtures("foreign", "no_labels")
def test_every_option_of_a_part_from_outside_can_be_set_and_no_other(command: Command) -> None:
    changes = {
        "activation.sharpness": 2.0, "network.hidden": 4, "function.exact_terminal": False, "loss.terms.small.power": 2,
        "sampler.early.share_of_horizon": 0.1, "optimizer.momentum": 0.9,
    }  # fmt: skip
    run = command("train", *SMOKE, *CHOSEN, *(f"{key}={value}" for key, value in changes.items()), "--dry-run")
    assert run.code == 0, run.text
    settings = OmegaConf.create(run.text)
    assert {key: OmegaConf.select(settings, key) for key in changes} == changes
    for key in changes:
        wrong = command("train", *SMOKE, *CHOSEN, f"{key}s=1")
        assert wrong.code != 0
        assert f"Did you mean {key.split('.')[-1]!r}?" in wrong.text
    refused = command("train", *SMOKE, *CHOSEN, "function.members=3")
    assert "function.members does not exist" in refused.text
    assert "Known: exact_terminal, name." in refused.text


@pytest.mark.usefixtures("foreign", "no_labels")
def test_what_a_game_sets_for_our_operator_is_no_option_of_another(command: Command) -> None:
    swapped = command("train", *SMOKE, "function=wrapped", "game=drone", "--dry-run")
    assert OmegaConf.create(swapped.text).function == {"name": "wrapped", "exact_terminal": True}


@pytest.mark.usefixtures("foreign", "no_labels")
def test_a_part_that_cannot_be_built_fails_its_job_alone(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(self: Shallow, *arguments: object, **options: object) -> None:
        raise TypeError("a mistake of its author")

    monkeypatch.setattr(Shallow, "__init__", broken)
    monkeypatch.setattr(launch, "perform", lambda *job: True)
    monkeypatch.setattr(launch, "objective", lambda *job: None)
    sweep = f"hydra.sweep.dir={tmp_path}/sweep"
    run = command("train", "-m", sweep, *SMOKE, "network=shallow,deeponet")
    assert run.code == 1
    assert "Job 0 failed: TypeError: a mistake of its author" in run.text
    assert "#1" in run.text


def test_an_option_whose_default_is_a_whole_number_may_be_a_fraction_where_it_says_so() -> None:
    """Adam's weight decay is 0, of type float; SOAP's interval is a whole number."""
    assert train_settings(["optimizer=adam", "optimizer.weight_decay=0.1"]).optimizer["weight_decay"] == 0.1
    with pytest.raises(ValueError, match=r"precondition_frequency must be a valid integer; got 2\.5"):
        train_settings(["optimizer=soap", "optimizer.precondition_frequency=2.5"])
