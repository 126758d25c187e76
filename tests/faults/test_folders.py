"""Two runs in one folder, runs that would overwrite others, and runs that are gone."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import platform
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import hno
from hno.cli import output
from hno.cli.arguments import Arguments, UsageError
from hno.cli.launch import _chosen
from hno.cli.output import fresh, owned
from hno.cli.sweep import Job, show_jobs
from hno.data.folders import LOCK, claimed
from hno.report.runs import load
from hno.report.verdicts import why
from tests.cli import conftest
from tests.cli.conftest import SMOKE, Command, refused

clean_globals, command, no_pages = conftest.clean_globals, conftest.command, conftest.no_pages
no_labels = conftest.no_labels


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output, "MOMENT", 0.01)


def leave(folder: Path, status: str) -> Path:
    """A folder as a run leaves it."""
    folder.mkdir(parents=True)
    (folder / "results.json").write_text(json.dumps({"status": status, "reason": None, "table": [], "seconds": {}}))
    return folder


def test_runs_that_start_in_the_same_second_get_folders_of_their_own(tmp_path: Path) -> None:
    with ThreadPoolExecutor(20) as pool:
        folders = list(pool.map(lambda _: fresh(tmp_path / "day" / "12-00-00_game"), range(20)))
    assert len(set(folders)) == 20
    assert {folder.name for folder in folders} == {"12-00-00_game", *(f"12-00-00_game_{n}" for n in range(2, 21))}
    default, chosen = Arguments([], ["seed=0"], {}), Arguments([], ["hydra.run.dir=there"], {})
    assert _chosen("hydra.run.dir", default, str(tmp_path / "day" / "12-00-00_game")) not in folders
    assert _chosen("hydra.run.dir", chosen, str(folders[0])) == folders[0]
    print("20 runs in one second: 20 folders")


@pytest.mark.usefixtures("no_labels")
@pytest.mark.parametrize("words", [(), ("-m", "seed=0,1")])
def test_a_folder_in_which_a_run_is_at_work_is_refused(
    command: Command,
    tmp_path: Path,
    words: tuple[str, ...],
) -> None:
    folder = tmp_path / "taken"
    folder.mkdir()
    with claimed(folder / LOCK) as ours:
        assert ours
        run = command("train", *words, *SMOKE, f"hydra.sweep.dir={folder}", folder=folder)
    assert run.code == 2
    refused(run, f"{folder} is in use by process {os.getpid()} on {platform.node()} since 2", "--to")
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("file", ["best.ckpt", "last.ckpt", "previous.ckpt", "results.json"])
def test_what_a_run_has_left_is_not_overwritten(tmp_path: Path, file: str) -> None:
    folder = leave(tmp_path / "sweep" / "0_run", "finished" if file == "results.json" else "interrupted")
    (folder / file).touch()
    for place, jobs in ((folder, False), (folder.parent, True)):
        with pytest.raises(UsageError, match=f"{folder / file} would be overwritten"), owned(place, jobs=jobs):
            pass


@pytest.mark.usefixtures("no_labels")
def test_commands_and_calls_refuse_the_folder_of_a_finished_run(command: Command, tmp_path: Path) -> None:
    folder = leave(tmp_path / "run", "finished")
    run = command("train", *SMOKE, folder=folder)
    assert run.code == 2
    refused(run, f"{folder / 'results.json'} would be overwritten", "--to", "resume=<its folder>")
    assert [path.name for path in folder.iterdir()] == ["results.json"]
    with pytest.raises(ValueError, match="would be overwritten"):
        hno.train("narrow_road", folder=folder, settings={"experiment": "smoke"})


@pytest.mark.parametrize("status", ["failed", "running", "interrupted"])
def test_a_run_that_left_nothing_may_be_repeated_in_its_folder(tmp_path: Path, status: str) -> None:
    with owned(leave(tmp_path / "run", status)):
        pass


def test_the_run_of_a_folder_goes_on_there(tmp_path: Path) -> None:
    folder = leave(tmp_path / "run", "interrupted")
    (folder / "last.ckpt").touch()
    for resume in (folder, folder / "last.ckpt"):
        with owned(folder, str(resume)):
            pass
    with pytest.raises(UsageError, match="overwritten"), owned(folder, str(tmp_path)):
        pass


def test_a_run_that_says_running_without_a_process_is_lost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = leave(tmp_path / "sweep" / "0", "running")
    (folder / LOCK).touch()  # a killed process leaves it
    (run,) = load(folder).runs
    assert (run.status, why(run)[:5]) == ("lost", "lost:")
    show_jobs([Job(0, folder, ())])
    assert "Job 0 lost: its process ended without a word" in capsys.readouterr().out
    with claimed(folder / LOCK):
        (run,) = load(folder).runs
        assert (run.status, why(run)) == ("running", "unfinished: it is still at work.")


def test_where_there_are_no_locks_a_run_is_unprotected_and_told_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def flock(*arguments: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", flock)
    with owned(leave(tmp_path / "run", "running")):
        assert "has no file locks" in caplog.text
        (run,) = load(tmp_path / "run").runs
        assert run.status == "running", "it cannot be told"


@pytest.mark.slow
def test_of_two_processes_in_one_folder_one_runs(tmp_path: Path, cache: Path) -> None:
    words = ("-m", "hno", "train", *SMOKE, "--to", str(tmp_path / "run"))
    runs = [
        subprocess.Popen([sys.executable, *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        for _ in range(4)
    ]
    texts = [run.communicate()[0] for run in runs]
    assert sorted(run.returncode for run in runs) == [0, 2, 2, 2]
    assert sum("is in use by process" in text for text in texts) == 3
    assert json.loads((tmp_path / "run" / "results.json").read_text())["status"] == "finished"
    print("4 processes, 1 folder: 1 runs, 3 refused")
