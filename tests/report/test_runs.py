"""Folders that are partial, damaged or foreign are read as far as they go, and the rest is named."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hno.report.records import Run
from hno.report.runs import NoRunsError, load
from tests.report.folders import GRID5, make_results, row, write_run, write_sweep

DRONE = make_results("drone", "sno", "tanh", 0, np.random.default_rng(0), GRID5[:3])


def only(folder: Path) -> Run:
    (run,) = load(folder).runs
    return run


def test_a_whole_run_is_read_without_remarks(tmp_path):
    run = only(write_run(tmp_path / "run", DRONE))
    assert run.notes == []
    assert (run.name, run.status, run.game, run.seed) == ("run", "finished", "drone", 0)
    assert len(run.table) == 3
    assert len(run.episodes) == 6
    assert run.episodes[0].positions.shape == (51, 2, 3)
    assert run.settings["operator.width"] == "64"
    assert "game.constants" not in run.settings
    assert len(run.curves["loss/total"]) == 40
    assert run.command == "python train.py game=drone operator=sno function=value activation=tanh seed=0"


def test_a_sweep_says_what_it_is(tmp_path):
    sweep = load(write_sweep(tmp_path, 4))
    assert sweep.command.startswith("python train.py -m game=narrow_road,lane_change,drone operator=hno,sno")
    assert [run.status for run in sweep.runs] == ["finished", "finished", "lost", "failed"]


def test_jobs_are_in_the_order_of_their_numbers(tmp_path):
    for job in (10, 2, 0):
        write_run(tmp_path / f"{job}_drone", DRONE, extras=False)
    assert [run.name for run in load(tmp_path).runs] == ["0_drone", "2_drone", "10_drone"]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "not JSON"),
        ('{"status": "finished", "table": [', "not JSON"),
        ("[" * 100_000, "not JSON"),
        ("[1, 2]", "not hno's"),
        ('{"accuracy": 0.9}', "not hno's"),
        ('{"status": 3, "table": []}', "not hno's"),
        (b"\xff\xfe\x00", "not JSON"),
    ],
)
def test_foreign_results_are_skipped_with_a_reason(tmp_path, text, reason):
    write_run(tmp_path / "good", DRONE, extras=False)
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "results.json").write_bytes(text if isinstance(text, bytes) else text.encode())
    sweep = load(tmp_path)
    assert [run.name for run in sweep.runs] == ["good"]
    assert [(entry.name, reason in entry.reason) for entry in sweep.skipped] == [("bad", True)]


def test_a_job_that_wrote_nothing_is_named(tmp_path):
    write_run(tmp_path / "good", DRONE, extras=False)
    (tmp_path / "killed" / ".hydra").mkdir(parents=True)
    (skipped,) = load(tmp_path).skipped
    assert skipped.name == "killed"
    assert "no results.json" in skipped.reason


@pytest.mark.parametrize("folder", ["empty", "missing", "foreign"])
def test_a_folder_without_runs_is_refused(tmp_path, folder):
    (tmp_path / "empty").mkdir()
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "results.json").write_text('{"accuracy": 1}')
    with pytest.raises(NoRunsError, match=r"is not a folder|holds no run"):
        load(tmp_path / folder)


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (row((1.0, 1.0), 3) | {"collisions": 300}, "300 collisions of 200"),
        (row((1.0, 1.0), 3) | {"collisions": None}, "outcome.collisions: input should be a valid integer, got None"),
        (row((1.0, 1.0), 3) | {"safe_starts": True}, "outcome.safe_starts: input should be a valid integer, got True"),
        (row((1.0, 1.0), 3) | {"theta": "1,1"}, "theta"),
        (row((1.0, 1.0), 3) | {"median_excess_cost": float("nan")}, "finite"),
        (row((1.0, 1.0), 3) | {"theta": [1, None]}, "theta"),
        ("nonsense", "expected an object, got 'nonsense'"),
    ],
)
def test_rows_that_contradict_themselves_are_left_out_and_named(tmp_path, bad, reason):
    run = only(write_run(tmp_path / "run", {**DRONE, "table": [bad, row((2.0, 2.0), 1)]}, extras=False))
    assert [entry["theta"] for entry in run.table] == [(2.0, 2.0)]
    assert any(reason in note for note in run.notes)


def test_a_metrics_file_that_is_being_written_gives_its_whole_lines(tmp_path):
    folder = write_run(tmp_path / "run", DRONE)
    (folder / "csv" / "metrics.csv").write_text("loss/total,step\n0.5,1\nnan,2\n0.25,3\n0.1")
    assert only(folder).curves == {"loss/total": [(1, 0.5), (3, 0.25)]}


def test_missing_and_damaged_companions_are_named(tmp_path):
    folder = write_run(tmp_path / "run", DRONE)
    (folder / "csv" / "metrics.csv").write_bytes(b"\xff\xfe")
    (folder / "episodes.json").write_text("{")
    (folder / ".hydra" / "hydra.yaml").write_text("[: :")
    run = only(folder)
    assert (run.curves, run.episodes, run.command) == ({}, [], None)
    assert len(run.notes) == 2


def test_episodes_end_where_they_stop_being_finite(tmp_path):
    folder = write_run(tmp_path / "run", DRONE)
    content = json.loads((folder / "episodes.json").read_text())
    content["episodes"][0]["positions"][20][0][0] = None
    content["episodes"][1]["t"] = "soon"
    (folder / "episodes.json").write_text(json.dumps(content))
    run = only(folder)
    assert len(run.episodes) == 5
    assert len(run.episodes[0].t) == 20
    assert any("episode is left out" in note for note in run.notes)


def test_episodes_outside_the_folder_are_not_read(tmp_path):
    secret = write_run(tmp_path / "other", DRONE)
    run = only(write_run(tmp_path / "runs" / "run", {**DRONE, "episodes": str(secret / "episodes.json")}, extras=False))
    assert run.episodes == []


def test_an_entry_of_the_wrong_kind_is_named_in_one_sentence(tmp_path):
    write_run(tmp_path / "good", DRONE, extras=False)
    write_run(tmp_path / "bad", {**DRONE, "seconds": {"labels": "soon"}}, extras=False)
    (skipped,) = load(tmp_path).skipped
    assert skipped.reason == ("results.json is not hno's: seconds.labels: input should be a valid number, got 'soon'")


def test_every_model_of_an_evaluation_is_a_run(tmp_path):
    models = [
        {
            "checkpoint": f"{name}.ckpt",
            "game": "drone",
            "operator": name,
            "activation": "tanh",
            "table": [row((1.0, 1.0), k)],
        }
        for k, name in enumerate(("hno", "sno"))
    ]
    results = {
        **DRONE,
        **models[0],
        "models": models,
        "comparison": [{"other": "sno.ckpt"}],
        "config": {"checkpoint": "?"},
    }
    first, second = load(write_run(tmp_path / "evaluation", results, extras=False)).runs
    assert (first.operator, second.operator) == ("hno", "sno")
    assert [run.table[0]["collisions"] for run in (first, second)] == [0, 1]
    assert [run.settings["checkpoint"] for run in (first, second)] == ["hno.ckpt", "sno.ckpt"]
    assert ["comparison" in run.entries for run in (first, second)] == [True, False]
