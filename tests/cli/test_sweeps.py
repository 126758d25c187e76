"""W&B sweeps and the paper's grid choose what exists."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf
from wandb.sdk.launch.sweeps.utils import create_sweep_command, create_sweep_command_args

from hno.cli import launch
from hno.cli.arguments import Arguments
from hno.cli.build import check
from hno.cli.config import compose, for_hydra
from hno.cli.media import numbers
from hno.cli.results import Results
from hno.cli.settings import TrainSettings
from hno.games import games
from tests.cli.conftest import SMOKE, Command
from tests.cli.test_train import losses
from tests.report.tables import type_row
from tests.walkers import Walkers

SWEEPS = sorted((Path(__file__).parents[2] / "sweeps").glob("*.yaml"))
GAMES, OPERATORS = ("narrow_road", "lane_change", "drone"), ("hno", "sno")
RATES = {"tanh": 3e-3, "sin": 3e-3, "relu": 1e-2}
STARTS = {"narrow_road": 200, "lane_change": 200, "drone": 60}


def read(path: Path) -> dict[str, Any]:
    content = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
    assert isinstance(content, dict)
    return content


def values(parameter: dict[str, Any]) -> list[Any]:
    """Values to try: all of a list, or both ends and the middle of a distribution."""
    if "value" in parameter:
        return [parameter["value"]]
    if "values" in parameter:
        return parameter["values"]
    low, high = parameter["min"], parameter["max"]
    assert low < high
    assert low > 0 or "log" not in parameter["distribution"]
    return [low, (low + high) / 2, high]


def arguments(sweep: dict[str, Any], chosen: dict[str, Any]) -> list[str]:
    """The command line that `wandb agent` makes of a sweep's `command`."""
    given = create_sweep_command_args({"args": {name: {"value": value} for name, value in chosen.items()}})
    macros = {**given, "env": ["/usr/bin/env"], "interpreter": ["python"], "program": [sweep["program"]]}
    words = map(str, create_sweep_command(list(sweep["command"])))
    return [
        word
        for part in words
        for word in (macros[part[2:-1]] if part.startswith("${") and part.endswith("}") else [part])
    ]


@pytest.mark.parametrize("path", SWEEPS, ids=lambda path: path.stem)
def test_parameters_of_a_sweep_are_configuration_keys(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WANDB_SWEEP_ID", "s1")
    monkeypatch.setenv("WANDB_RUN_ID", "r1")
    sweep = read(path)
    trials = {name: values(parameter) for name, parameter in sweep["parameters"].items()}
    for trial in range(max(map(len, trials.values()))):
        chosen = {name: some[trial % len(some)] for name, some in trials.items()}
        env, python, program, *overrides = arguments(sweep, chosen)
        assert (env, python, program) == ("/usr/bin/env", "python", "train.py")
        config = compose("train", for_hydra("train", Arguments([], overrides, {})))
        assert HydraConfig.get().run.dir == "outputs/sweeps/s1/r1"
        for name, value in chosen.items():
            got = OmegaConf.select(config, name)
            assert (got.name if OmegaConf.is_dict(got) else got) == value
        check(config)


def test_the_metric_of_every_sweep_is_logged(command: Command) -> None:
    run = command("train", *SMOKE, "trainer.max_steps=2", "trainer.validate_every=1")
    logged = set(losses(run.folder)[-1])
    assert {read(path)["metric"]["name"] for path in SWEEPS} <= logged
    assert all(read(path)["metric"]["goal"] == "minimize" for path in SWEEPS)
    assert "test/collision_rate" in numbers({"table": [type_row((1, 1), 0, 9)], "seconds": {}})


def test_grid_and_bayes_are_there() -> None:
    assert [(path.stem, read(path)["method"]) for path in SWEEPS] == [("bayes", "bayes"), ("grid", "grid")]


Grid = list[tuple[Any, ...]]


@pytest.fixture
def grid(command: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Any]:
    """Jobs of `experiment=paper_grid` with what is given on the command line, without running them."""

    def jobs(*overrides: str) -> Grid:
        made: Grid = []

        def take(task: launch.Task, chosen: TrainSettings, folder: Path) -> Results:
            assert (chosen.function["name"], chosen.function["members"]) == ("value", 1), "the paper's are values"
            tests, names = chosen.evaluation, (chosen.operator.name, chosen.activation["name"])
            made.append((
                chosen.game.name, *names, chosen.seed, chosen.optimizer["lr"], tests.starts, tests.safe,
                len(tests.types), chosen.trainer.max_steps,
            ))  # fmt: skip
            return Results(folder / "results.json", {})

        monkeypatch.setattr(launch, "perform", take)
        monkeypatch.setattr(launch, "show_jobs", lambda jobs, again: None)
        run = command("train", *overrides, "experiment=paper_grid", f"hydra.sweep.dir={tmp_path}/sweep")
        assert run.code == 0, run.text
        return made

    return jobs


def test_the_papers_grid_takes_every_activation_at_its_own_rate(grid: Any) -> None:
    assert grid("-m", "seed=1", "activation=sin") == [
        (game, operator, "sin", 1, 3e-3, STARTS[game], True, 25, 2000) for game, operator in product(GAMES, OPERATORS)
    ]
    assert grid("-m", "seed=1", "game=drone", "operator=hno") == [
        ("drone", "hno", activation, 1, rate, 60, True, 25, 2000) for activation, rate in RATES.items()
    ]


@pytest.mark.slow
def test_the_papers_grid_is_every_combination(grid: Any) -> None:
    assert grid("-m", "seed=1") == [
        (game, operator, activation, 1, RATES[activation], STARTS[game], True, 25, 2000)
        for game, operator, activation in product(GAMES, OPERATORS, RATES)
    ]


def test_the_command_line_narrows_the_grid(grid: Any) -> None:
    made = grid("-m", "game=drone", "activation=sin", "operator=sno", "paper_grid.lr.sin=7e-4", "evaluation.starts=5")
    assert made == [("drone", "sno", "sin", seed, 7e-4, 5, True, 25, 2000) for seed in range(3)]


def test_one_cell_of_the_grid(grid: Any) -> None:
    assert grid("activation=relu") == [("narrow_road", "sno", "relu", 0, 1e-2, 200, True, 25, 2000)]


def test_games_of_ones_own_have_a_place_in_the_grid(grid: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(games, "_classes", {**games._classes, "walkers": Walkers})
    assert grid("game=walkers") == [("walkers", "sno", "sin", 0, 3e-3, 200, True, 25, 2000)]
