"""What is printed at the end of a multirun."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from hno.cli import launch, pages
from hno.cli.sweep import Job, show_jobs
from tests.cli.conftest import SMOKE, Command, Outcome
from tests.report.tables import type_row


def job(root: Path, number: int, settings: tuple[str, ...] = (), **entries: Any) -> Job:
    """A job that left results."""
    folder = root / str(number)
    folder.mkdir()
    names = {"operator": "sno", "function": "value", "activation": "tanh", "seed": 0}
    head = {"status": "finished", "reason": None, "seconds": {}}
    (folder / "results.json").write_text(json.dumps({**names, **head, "table": [], **entries}))
    return Job(number, folder, settings)


write_page = pages.write
"""The real one."""
pytestmark = pytest.mark.usefixtures("no_pages")


def lines(printed: str) -> list[list[str]]:
    """Rows of the table, by words."""
    return [line.split() for line in printed.splitlines() if line.rstrip().endswith((" finished", " failed"))]


def test_jobs_are_sorted_and_pooled_over_types(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = [type_row((1, 1), 1, 100), type_row((2.5, 5), 3, 100)]
    jobs = [
        job(tmp_path, 0, game="narrow_road", seed=10, table=table, seconds={"labels": 1.6, "training": 60.0}),
        job(tmp_path, 1, game="narrow_road", seed=2, table=[type_row((1, 1), 0, 0)]),
        job(tmp_path, 2, game="drone", seed=3, table=[type_row((1, 1), 0, 600)]),
    ]
    show_jobs(jobs)
    printed = capsys.readouterr().out
    assert [" ".join(row) for row in lines(printed)] == [
        "2 drone sno value tanh 3 0 of 600 0.00 to 0.61 % 0.00 % +10.0 % n/a finished",
        "1 narrow_road sno value tanh 2 n/a n/a n/a n/a n/a finished",
        "0 narrow_road sno value tanh 10 4 of 200 0.55 to 5.04 % 3.00 % at 2.5, 5 +10.0 % 62 finished",
    ]
    assert printed.splitlines()[-1] == f"Page: {tmp_path}"


def test_only_settings_that_differ_are_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    common = ("game=drone", "trainer.max_steps=5")
    jobs = [job(tmp_path, n, (*common, f"seed={n}", f"optimizer.lr={n}"), game="drone", seed=n) for n in range(2)]
    show_jobs(jobs)
    printed = capsys.readouterr().out
    assert [row[6] for row in lines(printed)] == ["optimizer.lr=0", "optimizer.lr=1"]
    assert "max_steps" not in printed
    assert "seed=" not in printed


@pytest.mark.parametrize("content", ["", "[1", "null"])
def test_a_job_without_readable_results_is_a_failed_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str
) -> None:
    broken = job(tmp_path, 0)
    (broken.folder / "results.json").write_text(content)
    gone = Job(1, tmp_path / "nowhere", ())
    show_jobs([broken, gone])
    printed = capsys.readouterr().out
    assert [row[-1] for row in lines(printed)] == ["failed", "failed"]
    assert printed.count("no results (") == 2


def test_a_failed_job_is_in_the_table_with_its_reason_and_the_others_go_on(command: Command, tmp_path: Path) -> None:
    sweep = tmp_path / "sweep"
    run = command("train", "-m", f"hydra.sweep.dir={sweep}", *SMOKE, "trainer.max_steps=2", "optimizer.lr=1e30,0.001")
    assert run.code == 1
    table = run.text[run.text.rindex("2 jobs") :]
    assert [(row[0], row[6], row[-1]) for row in lines(table)] == [
        ("0", "optimizer.lr=1e+30", "failed"), ("1", "optimizer.lr=0.001", "finished"),
    ]  # fmt: skip
    assert "Job 0 failed: DivergedError: " in table
    assert table.splitlines()[-1] == f"Page: {sweep}"


def test_a_job_whose_configuration_cannot_be_resolved_fails_alone(command: Command, tmp_path: Path) -> None:
    """Adam has no such entry, SOAP has."""
    sweep = f"hydra.sweep.dir={tmp_path}/sweep"
    entry = "trainer.max_steps=${optimizer.precondition_frequency}"
    run = command("train", "-m", sweep, *SMOKE, entry, "optimizer=adam,soap", "hydra.sweeper.max_batch_size=1")
    assert run.code == 1
    found = [Outcome(0, "", folder).results for folder in sorted((tmp_path / "sweep").glob("[0-9]*"))]
    assert [results["status"] for results in found] == ["failed", "finished"]
    assert "optimizer.precondition_frequency" in found[0]["reason"]
    assert (found[0]["game"], found[0]["operator"]) == ("narrow_road", "hno")
    assert "Job 0 failed: Interpolation" in run.text
    assert "Traceback" not in run.text


def test_an_interrupted_multirun_shows_what_there_is(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcomes = iter([True, KeyboardInterrupt()])

    def perform(*job: object) -> bool:
        outcome = next(outcomes)
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome

    monkeypatch.setattr(launch, "perform", perform)
    monkeypatch.setattr(launch, "objective", lambda *job: None)
    printed: list[int] = []
    monkeypatch.setattr("hno.cli.launch.show_jobs", lambda jobs, again: printed.extend(job.number for job in jobs))
    run = command("train", "-m", f"hydra.sweep.dir={tmp_path}/sweep", *SMOKE, "seed=0,1,2")
    assert run.code == 130
    assert printed == [0, 1]


def test_a_single_run_ends_with_its_page(command: Command) -> None:
    run = command("train", *SMOKE, "trainer.max_steps=1")
    assert " jobs" not in run.text
    assert f"Page: {run.folder}" in run.text.splitlines()


def test_a_failed_run_has_a_page_with_its_reason(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pages, "write", write_page)
    run = command("train", *SMOKE, "data.cache=/proc/nowhere")
    assert run.code == 1
    assert f"Page: {run.folder / pages.PAGE}" in run.text.splitlines()
    assert "Labels cannot be written" in (run.folder / pages.PAGE).read_text()


def test_a_job_that_is_refused_leaves_its_reason_and_no_page(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(launch, "perform", lambda *job: True)
    monkeypatch.setattr(launch, "objective", lambda *job: None)
    sweep = f"hydra.sweep.dir={tmp_path}/sweep"
    run = command("train", "-m", sweep, *SMOKE, "operator=hno,sno", "loss.weights.residual=0.1")
    assert run.code == 1
    found = {folder.name[2:]: folder for folder in (tmp_path / "sweep").glob("[0-9]*")}
    assert not (found["narrow_road_hno_auto_sin"] / "results.json").exists()
    left = Outcome(0, "", found["narrow_road_sno_auto_sin"]).results
    assert (left["status"], left["operator"]) == ("failed", "sno")
    assert "needs a weight and every weight a term" in left["reason"]
    assert not list((tmp_path / "sweep").rglob("report.html"))


def test_one_job_is_no_jobs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    show_jobs([job(tmp_path, 0)])
    assert "1 job" in [line.strip() for line in capsys.readouterr().out.splitlines()]
