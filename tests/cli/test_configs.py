from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig

from hno.cli.arguments import Arguments
from hno.cli.build import build, check
from hno.cli.calls import train_settings
from hno.cli.config import compose, for_hydra, register_plugins
from hno.cli.confs import choices, config_dir, groups
from hno.cli.main import main
from hno.cli.resume import training_hash
from hno.cli.settings import TrainSettings
from hno.data import GameData
from hno.data.exchange import write_own
from hno.games import make
from hno.losses import STREAMS
from tests.fakes import fake_labels

GROUPS = sorted(path.name for path in config_dir().iterdir() if path.is_dir())
CHOICES = [(group, path.stem) for group in GROUPS for path in sorted((config_dir() / group).glob("*.yaml"))]
GAMES, OPERATORS, ACTIVATIONS = ("narrow_road", "lane_change", "drone"), ("hno", "sno"), ("tanh", "sin", "relu")


@pytest.fixture(autouse=True)
def plugins() -> None:
    register_plugins()


def composed(*overrides: str, name: str = "train") -> DictConfig:
    """A configuration as a command line composes it."""
    return compose(name, for_hydra(name, Arguments([], list(overrides), {})))


def settings(*overrides: str) -> TrainSettings:
    """The settings of a training that passes its check."""
    return train_settings(overrides)


def data_of(chosen: TrainSettings) -> GameData:
    return build(chosen).data


@pytest.mark.parametrize(("group", "choice"), CHOICES)
def test_every_choice_of_every_group_composes(group: str, choice: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if choice in ("gpu", "mps"):  # refused where there is none
        monkeypatch.setattr("hno.cli.build._check_devices", lambda settings, built: None)
    settings(f"{group}={choice}")


def test_the_groups_of_the_configuration_are_folders() -> None:
    assert set(groups("train")) == set(GROUPS)


@pytest.mark.parametrize("experiment", [choice for group, choice in CHOICES if group == "experiment"])
@pytest.mark.parametrize(("game", "operator"), list(product(GAMES, OPERATORS)))
def test_every_experiment_builds_for_every_game_and_operator(experiment: str, game: str, operator: str) -> None:
    chosen = settings(f"experiment={experiment}", f"game={game}", f"operator={operator}")
    needed = {"sno": {"bvp"}, "hno": STREAMS - ({"terminal"} if chosen.function["exact_terminal"] else set())}
    assert data_of(chosen).streams == needed[operator]


@pytest.mark.parametrize("experiment", ["paper", "paper_grid"])
def test_the_papers_comparison_has_as_few_types_for_the_drone_as_for_the_cars(experiment: str) -> None:
    drone, car = (settings(f"game={game}", f"experiment={experiment}").data for game in ("drone", "narrow_road"))
    assert drone == car
    assert settings("game=drone").data.types == "grid5"


@pytest.mark.parametrize(
    ("overrides", "phases"), [((), (400, 400, 1200)), (("experiment=paper_grid",), (800, 600, None))]
)
def test_hybrid_training_ends_supervised_but_in_the_papers_comparison(
    overrides: tuple[str, ...], phases: tuple[int, int, int | None]
) -> None:
    data = data_of(settings("operator=hno", "trainer.max_steps=2000", *overrides))
    assert data.collocation.curriculum == phases


def test_own_label_files_reach_the_data(tmp_path: Path) -> None:
    game, path = make("narrow_road"), tmp_path / "mine.safetensors"
    write_own(path, game, fake_labels(game, (2.5, 2.5), 12), "a test")
    data = data_of(settings("game=narrow_road", f"data.files=[{path}]", "data.types=[]", "data.validation=2"))
    assert data.type_list == [(2.5, 2.5)]
    assert not data.requests


def test_every_registered_class_has_a_choice() -> None:
    assert set(GAMES) <= set(choices("game"))
    assert set(OPERATORS) <= set(choices("operator"))
    assert set(ACTIVATIONS) <= set(choices("activation"))


def test_physics_stays_out_of_the_configuration() -> None:
    for game in GAMES:
        assert composed(f"game={game}").game == {"name": game, "constants": {}}


def options(chosen: TrainSettings) -> dict[str, Any]:
    return {"sampler": chosen.sampler, "loss": chosen.loss.terms, "function": chosen.function}


def test_every_option_of_what_is_registered_is_in_the_settings() -> None:
    found = options(settings("operator=hno", "sampler.band=0.5", "sampler.rollout.spread=0.1"))
    assert found["sampler"]["band"] == {"share": 0.5, "reach": 1.5}
    assert found["sampler"]["rollout"] == {"share": 0.0, "spread": 0.1}
    assert found["function"] == {"name": "potential", "exact_terminal": True, "members": 1}
    assert set(found["loss"]) == {"value", "costate", "branches", "boundary", "residual"}
    assert settings("function=value").function == {"name": "value", "exact_terminal": True, "members": 1}


def test_any_key_may_be_written_with_or_without_a_plus() -> None:
    for sign in ("", "+", "++"):
        chosen = settings(f"{sign}trainer.max_steps=7", f"{sign}game.constants.radius=1.3", f"{sign}activation=tanh")
        assert (chosen.trainer.max_steps, chosen.game.constants) == (7, {"radius": 1.3})
        assert chosen.activation == {"name": "tanh"}


@pytest.mark.parametrize("key", ["data.types", "evaluation.types", "validation.types"])
def test_types_need_no_quotes(key: str) -> None:
    group, name = key.split(".")
    assert getattr(getattr(settings(f"{key}=1,1;2.5,4"), group), name) == "1,1;2.5,4"
    assert getattr(getattr(settings(f"{key}=grid5"), group), name) == "grid5"


def test_an_experiment_may_have_entries_of_its_own_and_no_command_line_may(tmp_path: Path) -> None:
    (tmp_path / "experiment").mkdir()
    file = tmp_path / "experiment" / "mine.yaml"
    file.write_text("# @package _global_\nmine: {rate: 0.5}\noptimizer:\n  lr: ${mine.rate}\n")
    given = Arguments([], ["experiment=mine"], {"--config-dir": str(tmp_path)})
    assert check(compose("train", for_hydra("train", given))).optimizer["lr"] == 0.5
    with pytest.raises(ValueError, match=r"mine does not exist"):
        settings("mine.rate=0.5")


@pytest.mark.parametrize("words", [("train",), ("labels", "theta=1,1", "n=1")], ids=lambda words: words[0])
def test_a_misspelt_section_of_a_games_file_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...]
) -> None:
    """Also where the command reads no such section: what is right for a training says nothing to it."""
    (tmp_path / "game").mkdir()
    file = tmp_path / "game" / "mine.yaml"
    head = "# @package _global_\ngame: {name: narrow_road, constants: {}}\n"
    given = [*words, "game=mine", "--config-dir", str(tmp_path), "--dry-run"]
    file.write_text(head + "evaluation: {starts: 3}\n")
    assert main(given) == 0
    file.write_text(head + "evaluatoin: {starts: 3}\n")
    assert main(given) == 2
    assert "evaluatoin does not exist" in capsys.readouterr().err


def test_paper_recipe_is_the_published_one() -> None:
    chosen = settings("experiment=paper", "game=lane_change", "operator=sno")
    assert chosen.trainer.max_steps == 300_000
    assert chosen.optimizer == {"name": "adam", "lr": 1e-4, "schedule": "constant", "final_lr": 3e-5, "fused": True}
    assert chosen.data.trajectories == 2000
    assert {name: entry["share"] for name, entry in chosen.sampler.items()} == {
        "box": 1.0, "band": 0.0, "labels": 0.0, "rollout": 0.0,
    }  # fmt: skip
    assert data_of(chosen).collocation.curriculum == (100_000, 200_000, None)


def test_hash_names_what_determines_the_numbers() -> None:
    base = training_hash(settings())
    assert training_hash(settings()) == base
    free = "logger=csv", "data.cache=/some", "data.workers=1", "trainer.threads=1", "evaluation.starts=3"
    assert training_hash(settings(*free, "trainer.accelerator=cpu")) == base
    for other in (
        "seed=1",
        "game=drone",
        "operator=hno",
        "function=value",
        "activation=tanh",
        "optimizer.lr=1e-4",
        "data.trajectories=8",
    ):
        assert training_hash(settings(other)) != base


def test_configuration_is_found_beside_the_package() -> None:
    assert (config_dir() / "train.yaml").is_file()
    assert not list(Path(config_dir()).rglob("*.py"))
