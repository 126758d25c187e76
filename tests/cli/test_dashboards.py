"""What loggers are given, and which may be chosen."""

from __future__ import annotations

import csv
import json
import logging
from pathlib import Path
from typing import Any

import lightning.fabric.loggers.tensorboard as fabric
import pytest
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from hno.cli import media
from hno.cli.media import numbers, publish
from hno.report import pictures
from tests.cli.conftest import SMOKE, Command, refused
from tests.cli.wandb_file import offline_run
from tests.report.tables import episode, type_row


def results(*table: dict[str, Any], **entries: Any) -> dict[str, Any]:
    names = {"game": "narrow_road", "operator": "sno", "activation": "tanh", "seed": 0}
    return {**names, "status": "finished", "reason": None, "seconds": {"training": 53.0}, "table": table, **entries}


def last_row(folder: Path) -> dict[str, str]:
    """The one row of final results."""
    with (folder / "csv" / "metrics.csv").open() as file:
        *_, before, last = [{}, *csv.DictReader(file)]
    assert not before.get("test/safe_starts")
    return last


def events(folder: Path) -> EventAccumulator:
    return EventAccumulator(str(folder / "tensorboard")).Reload()


def test_numbers_name_every_type_the_worst_one_and_the_seconds() -> None:
    table = type_row((1, 1), 1, 100), type_row((1, 2.5), 2, 100), type_row((5, 5), 0, 0)
    assert numbers(results(*table, validation={"collision_rate": 0.01, "excess": 0.02})) == {
        "test/collision_rate": 0.015, "test/worst_type": 0.02, "test/excess_cost": 0.1, "test/safe_starts": 200,
        "best/collision_rate": 0.01, "best/excess_cost": 0.02, "collision_rate/1,1": 0.01,
        "collision_rate/1,2.5": 0.02, "seconds/training": 53.0,
    }  # fmt: skip


def test_what_does_not_exist_is_left_out() -> None:
    table = (type_row((5, 5), 0, 0),)
    assert numbers(results(*table, validation=None)) == {"test/safe_starts": 0, "seconds/training": 53}


def test_csv_and_tensorboard_together_get_numbers_and_pictures(command: Command) -> None:
    run = command("train", *SMOKE, "trainer.max_steps=2", "logger.names=[csv,tensorboard,csv]")
    assert run.code == 0, run.text
    wanted = numbers(run.results)
    assert wanted.keys() >= {"test/collision_rate", "collision_rate/1,1", "seconds/labels"}
    row = last_row(run.folder)
    assert {name: float(row[name]) for name in wanted} == pytest.approx(wanted)
    found = events(run.folder)
    scalars = {name: found.Scalars(name)[-1] for name in found.Tags()["scalars"]}
    assert {name: scalars[name].value for name in wanted} == pytest.approx(wanted)
    assert scalars["test/collision_rate"].step == run.results["steps"] == 2
    assert "loss/total" not in wanted
    assert "loss/total" in scalars
    chosen = found.PluginTagToContent("hparams")["_hparams_/session_start_info"]
    assert all(part in chosen for part in (b"narrow_road", b"hno", b"potential", b"sin", b"training_hash"))
    assert found.Tags()["images"] == ["collision_map"]
    assert found.Images("collision_map")[0].encoded_image_string.startswith(b"\x89PNG")


def test_csv_alone_draws_nothing(command: Command) -> None:
    run = command("train", *SMOKE, "trainer.max_steps=1")
    assert not list(run.folder.glob("collision_map*"))
    assert float(last_row(run.folder)["test/safe_starts"]) == 4


def test_wandb_gets_pictures_and_the_worst_stored_episode(command: Command, monkeypatch: Any) -> None:
    stored = {"episodes": [episode((1, 5), 0.4), episode((1, 1), -0.2), episode((5, 5), 0.1)]}

    def with_episodes(loggers: Any, content: dict[str, Any], folder: Path, step: int) -> None:
        (folder / "episodes.json").write_text(json.dumps(stored))
        Image.new("RGB", (9, 9)).save(folder / "rollout.png")
        publish(loggers, {**content, "episodes": "episodes.json"}, folder, step)

    monkeypatch.setattr("hno.cli.train.publish", with_episodes)
    titles = []
    monkeypatch.setattr(
        pictures,
        "rollout_picture",
        lambda shown, path, title: titles.append(title) or Image.new("RGB", (9, 9)).save(path),
    )
    run = command("train", *SMOKE, "trainer.max_steps=1", "logger=wandb")
    assert run.code == 0, run.text
    said = "most lost against the equilibrium at (1,1), clearance -0.20 m"
    assert titles == [f"narrow_road / hno / potential / sin\n{said}"]
    kept = {path.name.split("_")[0] for path in run.folder.glob("wandb/offline-run-*/files/media/*/*.png")}
    assert kept == {"worst", "rollout", "collision"}
    kept_run = offline_run(run.folder)
    summary = kept_run.summary
    assert any("lr" in name for row in kept_run.history for name in row)
    assert summary.keys() >= {"worst_episode/filenames", "rollout/filenames", "collision_map/filenames"}
    assert (summary["types/nrows"], summary["test/worst_theta"]) == (1, "1,1")


def test_a_logger_that_refuses_costs_a_warning_not_the_run(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    class Full(CSVLogger):
        def log_metrics(self, *_: Any, **__: Any) -> None:
            raise OSError(28, "No space left on device")

    good = CSVLogger(tmp_path, name="", version="csv")
    publish([Full(tmp_path / "full"), good], results(type_row((1, 1), 1, 10)), tmp_path, 7)
    assert [(r.levelno, "No space left" in r.getMessage()) for r in caplog.records] == [(logging.WARNING, True)]
    assert float(last_row(tmp_path)["collision_rate/1,1"]) == 0.1


def test_the_worst_episode_lost_most_and_a_collision_is_worse_than_any_cost(tmp_path: Path) -> None:
    def worst(*kept: dict[str, Any]) -> dict[str, Any] | None:
        (tmp_path / "episodes.json").write_text(json.dumps({"episodes": kept}))
        return media.worst_episode({"episodes": "episodes.json"}, tmp_path)

    near, dear = ({"clearance": c, "cost": cost, "label_cost": 10.0} for c, cost in ((0.01, 11.0), (2.0, 90.0)))
    struck = {"clearance": None, "cost": None, "label_cost": 10.0, "collided": True}
    assert worst(near, dear) == dear
    assert worst(near, struck, dear) == struck
    assert worst() is None


def test_the_table_of_types_has_numbers_in_its_cells() -> None:
    row = media._flat(type_row((1, 2.5), 3, 100))
    assert (row["types"], row["theta_1"], row["theta_2"], row["collisions"], row["rate"]) == ("1,2.5", 1, 2.5, 3, 0.03)
    assert all(value is None or isinstance(value, (bool, int, float)) for name, value in row.items() if name != "types")


def test_a_picture_that_fails_costs_a_warning_not_the_run(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*arguments: object) -> None:
        raise TypeError("no such colour")

    monkeypatch.setattr(pictures, "collision_map", broken)
    board = TensorBoardLogger(tmp_path, name="", version="tensorboard")
    publish([board], results(type_row((1, 1), 0, 10)), tmp_path, 1)
    assert [(r.levelno, "TypeError: no such colour" in r.getMessage()) for r in caplog.records] == [
        (logging.WARNING, True)
    ]
    assert events(tmp_path).Scalars("collision_rate/1,1")[0].value == 0


def test_games_of_three_get_no_map_and_the_reason(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        board = TensorBoardLogger(tmp_path, name="", version="tensorboard")
        publish([board], results(type_row((1, 1, 1), 0, 10)), tmp_path, 1)
    assert "two players" in caplog.text
    assert events(tmp_path).Scalars("collision_rate/1,1,1")[0].value == 0


@pytest.mark.usefixtures("no_labels")
def test_tensorboard_that_is_not_installed(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fabric, "_TENSORBOARD_AVAILABLE", False)
    monkeypatch.setattr(fabric, "_TENSORBOARDX_AVAILABLE", False)
    run = command("train", *SMOKE, "logger=tensorboard")
    refused(run, "TensorBoard is not installed: `pip install tensorboard`", "logger=csv")
    assert run.results["reason"].startswith("RuntimeError: TensorBoard is not installed")


@pytest.mark.usefixtures("no_labels")
@pytest.mark.parametrize(
    ("override", "message"),
    [
        *(
            (f"logger.names=[csv,{name}]", "logger.names.1 must be 'csv', 'tensorboard' or 'wandb'")
            for name in ("tensorbord", "7")
        ),
        *((f"logger.names={names}", "logger.names must be a valid list") for names in ("csv", "null")),
        ("logger.mode=onlin", "logger.mode must be 'auto', 'disabled', 'offline' or 'online'; got 'onlin'"),
        ("logger.mode=online", "W&B has no API key to run online"),
    ],
)
def test_loggers_that_cannot_be(command: Command, override: str, message: str) -> None:
    refused(command("train", *SMOKE, "logger=wandb", override), message)


def test_without_any_logger(command: Command) -> None:
    run = command("train", *SMOKE, "trainer.max_steps=1", "logger.names=[]")
    assert run.code == 0, run.text
    assert not (run.folder / "csv").exists()
