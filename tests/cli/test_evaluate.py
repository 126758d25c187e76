from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from torch import Tensor

import hno
from hno.cli.confs import config_dir
from hno.cli.evaluate import types_to_evaluate
from hno.control.rollout import Policy
from hno.data import labels as label_data
from hno.evaluation import closed_loop
from hno.evaluation.residuals import REGIONS
from hno.games import Game, make
from hno.games.base import ExtrapolationWarning
from hno.training.saving import seal
from hno.types import Trajectory
from tests.cli.conftest import SMOKE, Command, refused, save_random

FAST = ("workers=1", "starts=4", "dt=0.25")


def test_evaluation_of_a_trained_model_repeats_the_table_of_its_run(command: Command, tmp_path: Path) -> None:
    trained = command("train", *SMOKE, "trainer.max_steps=5", folder=tmp_path / "train")
    before = {path: path.read_bytes() for path in trained.folder.iterdir() if path.is_file()}
    run = command("evaluate", f"checkpoint={trained.folder}/last.ckpt", "theta=1,1", *FAST, folder=tmp_path / "eval")
    assert run.code == 0, run.text
    results = run.results
    assert results["table"] == trained.results["table"]
    assert results["table"][0]["costate_error"] is not None
    assert {name: results[name] for name in ("game", "operator", "activation", "seed", "status")} == {
        "game": "narrow_road", "operator": "hno", "activation": "sin", "seed": 0, "status": "finished",
    }  # fmt: skip
    assert "narrow_road / hno / potential / sin" in run.text
    assert {path: path.read_bytes() for path in before} == before


@pytest.mark.parametrize("words", [("{}",), ("checkpoint={}",), ("-m", "checkpoint={}")])
def test_the_folder_of_a_run_is_a_checkpoint(
    command: Command, random_checkpoint: Path, tmp_path: Path, words: tuple[str, ...]
) -> None:
    words = (*(word.format(random_checkpoint.parent) for word in words), f"hydra.sweep.dir={tmp_path}/sweep")
    run = command("evaluate", *words, "theta=1,1", "residuals=false", *FAST)
    assert run.code == 0, run.text
    results = run if "-m" not in words else run._replace(folder=tmp_path / "sweep" / "0")
    assert results.results["checkpoint"] == str(random_checkpoint)
    assert "2 jobs" not in run.text


def test_one_thread_unless_asked_otherwise(command: Command, random_checkpoint: Path) -> None:
    before = torch.get_num_threads()
    try:
        arguments = (f"checkpoint={random_checkpoint}", "theta=1,1", "residuals=false", *FAST)
        torch.set_num_threads(2)
        command("evaluate", *arguments)
        assert torch.get_num_threads() == 1
        command("evaluate", *arguments, "threads=2")
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


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
    types = types_to_evaluate("default", hno.load_policy(random_checkpoint))
    assert types == [(1.0, 1.0), (1.0, 2.0), (2.0, 2.0), (2.0, 4.0), (4.0, 5.0)]


def test_types_outside_the_range_warn(random_checkpoint: Path) -> None:
    with pytest.warns(ExtrapolationWarning, match="extrapolate"):
        assert types_to_evaluate("6,1", hno.load_policy(random_checkpoint)) == [(6.0, 1.0)]


@pytest.mark.usefixtures("no_labels")
@pytest.mark.parametrize(
    ("theta", "message"),
    [
        ("everything", "default, corners, gridN"),
        ("grid1", "corners, gridN"),
        ("1,1;2", "2 finite numbers"),
        ("1", "2 finite numbers"),
        ("1,1,1", "2 finite numbers"),
        ("1,nan", "2 finite numbers"),
        ("1,inf", "2 finite numbers"),
        ("1,1;", "corners, gridN"),
    ],
)
def test_impossible_types(command: Command, random_checkpoint: Path, theta: str, message: str) -> None:
    run = command("evaluate", f"checkpoint={random_checkpoint}", f"theta={theta}", *FAST)
    refused(run, message)
    assert not run.folder.exists()


@pytest.mark.usefixtures("no_labels")
@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("starts=0", "starts must be"),
        ("starts=-4", "starts must be"),
        *((f"{name}=true", f"{name} must be a") for name in ("starts", "seed", "workers", "delay", "noise", "widen")),
        ("starts=null", "starts must be a valid integer"),
        ("dt=0", "dt must be"),
        ("dt=5", "divides the horizon"),
        ("clearance=-1", "clearance must be"),
        ("clearance=nan", "clearance must be"),
        ("expected_game=drone", "of game 'narrow_road', expected 'drone'"),
        ("start=5", "Did you mean 'starts'?"),
        ("checkpoint=/nowhere/last.ckpt", "There is no checkpoint at /nowhere/last.ckpt"),
        ("checkpoint=[/nowhere/last.ckpt]", "There is no checkpoint at /nowhere/last.ckpt"),
        ("checkpoint=[]", "checkpoint must have at least 1 item"),
        ("residuals=yes please", "residuals must be a valid boolean"),
        ("robustness=1", "robustness must be a valid boolean"),
    ],
)
def test_impossible_settings(command: Command, random_checkpoint: Path, override: str, message: str) -> None:
    refused(command("evaluate", f"checkpoint={random_checkpoint}", *FAST, override), message)


@pytest.mark.usefixtures("no_labels")
def test_without_a_checkpoint(command: Command) -> None:
    refused(command("evaluate"), "checkpoint is missing: give it as checkpoint=<value>")


@pytest.mark.usefixtures("no_labels")
def test_the_folder_of_a_sweep_is_no_checkpoint(command: Command, tmp_path: Path) -> None:
    for name in ("0_sno", "1_hno"):
        (tmp_path / "sweep").mkdir(exist_ok=True)
        save_random(tmp_path / "sweep" / name / "last.ckpt")
    sweep = tmp_path / "sweep"
    run = command("evaluate", f"checkpoint={sweep}")
    refused(run, f"{sweep} is the folder of a sweep: name one of its runs, such as {sweep}/0_sno", "0_sno, 1_hno.")
    refused(command("train", *SMOKE, f"resume={sweep}"), f"{sweep} is the folder of a sweep")


@pytest.mark.usefixtures("no_labels")
def test_the_game_of_a_script_is_registered_by_importing_it(command: Command, tmp_path: Path) -> None:
    path = save_random(tmp_path / "random" / "last.ckpt")
    content = torch.load(path, weights_only=True)
    content["hno"]["game"] = "crossing"
    path.write_bytes(seal(content))
    run = command("evaluate", f"checkpoint={path}")
    refused(run, "'crossing', which is not registered here", "import that script first", "Known: ", "narrow_road")


@pytest.mark.usefixtures("no_labels")
@pytest.mark.parametrize("kept", [0.0, 0.5, 0.99])
def test_truncated_checkpoint(command: Command, random_checkpoint: Path, kept: float) -> None:
    content = random_checkpoint.read_bytes()
    random_checkpoint.write_bytes(content[: int(kept * len(content))])
    run = command("evaluate", f"checkpoint={random_checkpoint}")
    refused(run, "not a readable checkpoint")
    assert not run.folder.exists()


@pytest.mark.usefixtures("no_labels")
def test_unwritable_output_folder(command: Command, random_checkpoint: Path) -> None:
    run = command("evaluate", f"checkpoint={random_checkpoint}", folder=Path("/proc/nowhere"))
    refused(run, "output folder cannot be written", "/proc/nowhere")


def test_without_a_safe_start_the_rate_is_not_applicable(command: Command, random_checkpoint: Path) -> None:
    run = command("evaluate", f"checkpoint={random_checkpoint}", "theta=1,1", "clearance=50", *FAST)
    assert run.code == 0, run.text
    assert run.results["table"][0]["rate"] is None
    assert "n/a" in run.text
    assert "No rate (n/a) at (1, 1): of 4 starts none has an equilibrium that keeps 50 m" in run.text


@pytest.fixture
def no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ties are random starts here: tests/data/test_ties.py looks for them."""
    monkeypatch.setattr(label_data, "tie_states", lambda game, theta, count, draw: draw(2 * count)[count:])


@pytest.mark.slow
@pytest.mark.usefixtures("no_search")
def test_without_a_safe_start_every_section_says_so(command: Command, random_checkpoint: Path) -> None:
    both = f"checkpoint=[{random_checkpoint},{random_checkpoint}]"
    run = command("evaluate", both, "theta=1,1", "clearance=50", "robustness=true", *FAST)
    assert run.code == 0, run.text
    row = run.results["robustness"][0]
    (compared,) = run.results["comparison"]["models"]
    assert (row["safe_starts"], row["rate"], row["interval"], row["median_excess_cost"]) == (0, None, None, None)
    assert (compared["starts"], compared["difference"], compared["interval"], compared["p_value"]) == (0, *[None] * 3)
    assert "0.00 %" not in run.text


def other(checkpoint: Path, folder: Path, game: str = "narrow_road", seed: int = 1, **constants: float) -> Path:
    """Another operator with random weights."""
    path = checkpoint.parent.parent / folder / "last.ckpt"
    return save_random(path, make(game, **constants), "sno", seed, also=5.0)


def test_results_hold_the_configuration(command: Command, random_checkpoint: Path) -> None:
    config = command("evaluate", f"checkpoint={random_checkpoint}", "theta=1,1", "noise=0.1", *FAST).results["config"]
    assert (config["checkpoint"], config["theta"], config["noise"]) == ([str(random_checkpoint)], "1,1", 0.1)
    assert (config["starts"], config["residuals"]) == (4, True)


def test_residuals_are_a_section_that_can_be_switched_off(command: Command, random_checkpoint: Path) -> None:
    run = command("evaluate", f"checkpoint={random_checkpoint}", "theta=1,1;2,2", *FAST)
    rows = run.results["residuals"]
    assert [(row["theta"], row["region"]) for row in rows] == [
        (theta, region) for theta in ([1, 1], [2, 2]) for region in REGIONS
    ]
    assert all(row["physical"] > 0 and row["points"] > 0 for row in rows)
    assert "HJI residual" in run.text
    assert run.results["seconds"].keys() >= {"residuals", "evaluation"}
    without = command("evaluate", f"checkpoint={random_checkpoint}", "theta=1,1", "residuals=false", *FAST)
    assert "residuals" not in without.results
    assert "HJI residual" not in without.text


@pytest.mark.usefixtures("no_search")
def test_robustness_is_a_section_on_request(command: Command, random_checkpoint: Path) -> None:
    arguments = (f"checkpoint={random_checkpoint}", "theta=1,1;2,2", "residuals=false", *FAST)
    asked = (*arguments, "robustness=true", "conditions.heading={drift: 0.1, components: [2]}")
    run = command("evaluate", *asked)
    assert run.code == 0, run.text
    rows = {row["name"]: row for row in run.results["robustness"]}
    assert list(rows) == [*OmegaConf.load(config_dir() / "evaluate.yaml").conditions, "heading"]
    assert rows["heading"]["condition"] == {"drift": 0.1, "components": [2]}
    plain, table = rows["nominal"], run.results["table"]
    for name in ("safe_starts", "collisions"):
        assert plain[name] == sum(row[name] for row in table)
        assert [entry[name] for entry in plain["types"]] == [row[name] for row in table]
    assert rows["belief"]["condition"] == {"belief": 0.5}
    assert rows["symmetric"]["condition"] == {"symmetric": True}
    assert rows["ties"]["condition"] == {"ties": True}
    assert rows["widened"]["median_label_cost"] != plain["median_label_cost"]
    costs = [row["median_excess_cost"] for row in rows.values()]
    assert len(set(costs)) == len(costs), "every condition changes something"
    assert "Robustness" in run.text
    again = command("evaluate", *asked)
    assert again.results["robustness"] == run.results["robustness"]
    assert "robustness" not in command("evaluate", *arguments).results


@pytest.mark.usefixtures("no_labels")
def test_impossible_conditions(command: Command, random_checkpoint: Path) -> None:
    arguments = (f"checkpoint={random_checkpoint}", "robustness=true", *FAST)
    refused(command("evaluate", *arguments, "+conditions.delay.noisy=1"), "No condition entry named 'noisy'", "'noise'")
    refused(command("evaluate", *arguments, "+conditions.gusts.components=[7]"), "places in a player's state, 0 to 3")


def test_models_are_compared_on_the_same_starts(command: Command, random_checkpoint: Path) -> None:
    second = other(random_checkpoint, Path("second"))
    arguments = ("theta=1,1;2,2", "residuals=false", *FAST)
    run = command("evaluate", f"checkpoint=[{random_checkpoint},{second}]", *arguments)
    assert run.code == 0, run.text
    results, models = run.results, run.results["models"]
    assert [model["checkpoint"] for model in models] == [str(random_checkpoint), str(second)]
    assert [model["operator"] for model in models] == ["hno", "sno"]
    for model in models:
        alone = command("evaluate", f"checkpoint={model['checkpoint']}", *arguments).results
        assert alone["table"] == model["table"]
        assert "models" not in alone
    for name in ("checkpoint", "game", "operator", "activation", "table"):
        assert results[name] == models[0][name]
    (compared,) = results["comparison"]["models"]
    assert compared["checkpoint"] == str(second)
    for first, third, pair in zip(models[0]["table"], models[1]["table"], compared["types"], strict=True):
        assert pair["starts"] == first["safe_starts"] == third["safe_starts"]
        assert pair["both"] + pair["only_reference"] == first["collisions"]
        assert pair["both"] + pair["only_other"] == third["collisions"]
    for name in ("starts", "both", "only_reference", "only_other"):
        assert compared[name] == sum(pair[name] for pair in compared["types"])
    assert "random/last.ckpt" in run.text
    assert "compared against random/last.ckpt" in run.text


@pytest.mark.slow
def test_every_model_meets_the_same_safe_starts(
    command: Command, random_checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever it is, was trained with, and how it is disturbed: starts come from labels, and labels from the seed."""
    met: list[Tensor] = []
    original = closed_loop.rollout

    def watched(game: Game, policy: Policy, x0: Tensor, theta: Tensor, *others: Any, **options: Any) -> Trajectory:
        met.append(torch.cat([x0.flatten(1), theta], 1))
        return original(game, policy, x0, theta, *others, **options)

    monkeypatch.setattr(closed_loop, "rollout", watched)
    second, arguments = other(random_checkpoint, Path("second")), ("theta=1,1", "residuals=false", *FAST)
    tables = [
        command("evaluate", f"checkpoint={path}", *arguments, *more).results["table"]
        for path, more in ((random_checkpoint, ()), (second, ()), (second, ("noise=0.3", "delay=2")))
    ]
    assert len(met) == 3
    assert all(torch.equal(starts, met[0]) for starts in met)
    kinds = ("starts", "unsolved", "inevitable", "marginal", "safe_starts")
    assert len({tuple(table[0][kind] for kind in kinds) for table in tables}) == 1
    command("evaluate", f"checkpoint={second}", *arguments, "seed=7")
    assert not torch.equal(met[-1], met[0])


def test_default_types_are_those_of_all_models(command: Command, random_checkpoint: Path) -> None:
    second = other(random_checkpoint, Path("second"))
    run = command("evaluate", f"checkpoint=[{random_checkpoint},{second}]", "unseen=[]", "residuals=false", *FAST)
    assert [[row["seen"] for row in model["table"]] for model in run.results["models"]] == [[True, False], [True, True]]
    assert [row["theta"] for row in run.results["table"]] == [[1, 1], [5, 5]]


@pytest.mark.usefixtures("no_labels")
def test_models_of_different_games_are_refused(command: Command, random_checkpoint: Path) -> None:
    drone = other(random_checkpoint, Path("drone"), "drone")
    wide = other(random_checkpoint, Path("wide"), radius=1.5)
    run = command("evaluate", f"checkpoint=[{random_checkpoint},{drone}]", *FAST)
    refused(run, "Models of different games", "NarrowRoad()", f"{drone} plays Drone()", "Evaluate them one by one")
    assert not run.folder.exists()
    refused(command("evaluate", f"checkpoint=[{random_checkpoint},{wide}]", *FAST), "NarrowRoad(radius=1.5)")


def test_types_outside_the_range_are_in_the_summary(command: Command, random_checkpoint: Path) -> None:
    run = command("evaluate", f"checkpoint={random_checkpoint}", "theta=1,1;0.5,1", "residuals=false", *FAST)
    assert run.code == 0, run.text
    assert "ExtrapolationWarning" in run.text
    assert "results extrapolate: (0.5, 1)." in run.text
    assert [row["extrapolated"] for row in run.results["table"]] == [False, True]
