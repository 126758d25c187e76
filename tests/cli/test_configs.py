from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from pathlib import Path

import hydra
import pytest
from omegaconf import DictConfig, OmegaConf

from hno.cli.build import build_data, build_game, build_operator, check_numbers, plain
from hno.cli.config import choices, config_dir, register_plugins
from hno.cli.results import config_hash
from hno.data.exchange import write_own
from hno.games import make
from hno.losses import STREAMS
from hno.operators.deeponet import nets
from tests.fakes import fake_labels

GROUPS = sorted(path.name for path in config_dir().iterdir() if path.is_dir())
CHOICES = [(group, path.stem) for group in GROUPS for path in sorted((config_dir() / group).glob("*.yaml"))]
GAMES, OPERATORS, ACTIVATIONS = ("narrow_road", "lane_change", "drone"), ("hno", "sno"), ("tanh", "sin", "relu")


@pytest.fixture(autouse=True)
def hydra_here() -> Iterator[None]:
    register_plugins()
    with hydra.initialize_config_dir(str(config_dir()), version_base="1.3"):
        yield


def composed(*overrides: str, name: str = "train") -> DictConfig:
    """A configuration with all its interpolations resolved and nothing missing."""
    config = hydra.compose(name, overrides=list(overrides))
    OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    return config


@pytest.mark.parametrize(("group", "choice"), CHOICES)
def test_every_choice_of_every_group_composes(group: str, choice: str) -> None:
    check_numbers(composed(f"{group}={choice}"))


@pytest.mark.parametrize("experiment", [choice for group, choice in CHOICES if group == "experiment"])
@pytest.mark.parametrize(("game", "operator"), list(product(GAMES, OPERATORS)))
def test_every_experiment_builds_for_every_game_and_operator(experiment: str, game: str, operator: str) -> None:
    config = composed(f"experiment={experiment}", f"game={game}", f"operator={operator}")
    check_numbers(config)
    built = build_operator(config, build_game(config))
    needed = {"sno": {"bvp"}, "hno": STREAMS - ({"terminal"} if config.operator.exact_terminal else set())}
    assert build_data(config, built).streams == needed[operator]


@pytest.mark.parametrize(
    ("overrides", "members"), [((), 3), (("experiment=paper_grid",), 1), (("operator.members=5",), 5)]
)
def test_the_drone_is_a_median_of_nets_unless_asked_otherwise(overrides: tuple[str, ...], members: int) -> None:
    config = composed("game=drone", *overrides)
    assert len(nets(build_operator(config, build_game(config)).net)) == members


@pytest.mark.parametrize(
    ("overrides", "phases"), [((), (400, 400, 1200)), (("experiment=paper_grid",), (800, 600, None))]
)
def test_hybrid_training_ends_supervised_but_in_the_papers_comparison(
    overrides: tuple[str, ...], phases: tuple[int, int, int | None]
) -> None:
    config = composed("operator=hno", "trainer.max_steps=2000", *overrides)
    assert build_data(config, build_operator(config, build_game(config))).curriculum == phases


def test_own_label_files_reach_the_data(tmp_path: Path) -> None:
    game, path = make("narrow_road"), tmp_path / "mine.safetensors"
    write_own(path, game, fake_labels(game, (2.5, 2.5), 12), "a test")
    config = composed("game=narrow_road", f"data.files=[{path}]", "data.types=[]", "data.validation=2")
    check_numbers(config)
    data = build_data(config, build_operator(config, build_game(config)))
    assert data.type_list == [(2.5, 2.5)]
    assert not data.requests
    with pytest.raises(ValueError, match=r"data.types must list player types"):
        check_numbers(composed("data.types=[]"))


@pytest.mark.parametrize(("game", "operator", "activation"), list(product(GAMES, OPERATORS, ACTIVATIONS)))
def test_every_combination_is_built_as_named(game: str, operator: str, activation: str) -> None:
    config = composed(f"game={game}", f"operator={operator}", f"activation={activation}")
    built = build_operator(config, build_game(config))
    assert built.names() == {"game": game, "operator": operator, "activation": activation}


def test_every_registered_class_has_a_choice() -> None:
    assert set(GAMES) <= set(choices("game"))
    assert set(OPERATORS) <= set(choices("operator"))
    assert set(ACTIVATIONS) <= set(choices("activation"))


def test_evaluation_composes() -> None:
    assert composed("checkpoint=some.ckpt", name="evaluate").theta == "default"


def test_physics_stays_out_of_the_configuration() -> None:
    for game in GAMES:
        assert plain(composed(f"game={game}").game) == {"name": game, "constants": {}}


def test_paper_recipe_is_the_published_one() -> None:
    config = composed("experiment=paper", "game=lane_change", "operator=sno")
    assert config.trainer.max_steps == 300_000
    assert (config.optimizer.name, config.optimizer.lr, config.optimizer.schedule) == ("adam", 1e-4, "constant")
    assert config.data.trajectories == 2000
    assert plain(config.sampler) == {"box": 1.0, "band": 0.0, "labels": 0.0, "rollout": 0.0}
    curriculum = build_data(config, build_operator(config, build_game(config))).curriculum
    assert curriculum == (100_000, 200_000, None)


def test_hash_names_what_determines_the_numbers() -> None:
    base = config_hash(composed())
    assert config_hash(composed()) == base
    for same in ("logger=csv", "resume=/some/last.ckpt", "data.cache=/some", "data.workers=1", "trainer.threads=1"):
        assert config_hash(composed(same)) == base
    for other in (
        "seed=1",
        "game=drone",
        "operator=hno",
        "activation=tanh",
        "optimizer.lr=1e-4",
        "data.trajectories=8",
    ):
        assert config_hash(composed(other)) != base


def test_configuration_is_found_beside_the_package() -> None:
    assert (config_dir() / "train.yaml").is_file()
    assert not list(Path(config_dir()).rglob("*.py"))
