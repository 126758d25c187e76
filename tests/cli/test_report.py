"""`hno report` as people call it."""

from __future__ import annotations

import importlib.util
import os
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from hno.cli.main import main
from hno.data.folders import LOCK, claimed
from hno.report.runs import load
from tests.report.folders import GRID5, make_results, write_run

RESULTS = make_results("drone", "sno", "tanh", 0, np.random.default_rng(0), GRID5[:2])


def test_the_page_lies_in_the_folder_and_its_path_is_printed(tmp_path, capsys):
    write_run(tmp_path, RESULTS)
    assert main(["report", str(tmp_path)]) == 0
    assert capsys.readouterr().out.split() == [str(tmp_path / "report.html")]
    assert (tmp_path / "report.html").read_text().lstrip().startswith("<!doctype html>")


def test_out_chooses_the_file(tmp_path):
    write_run(tmp_path / "run", RESULTS)
    assert main(["report", str(tmp_path / "run"), "--to", str(tmp_path / "new" / "page.html")]) == 0
    assert (tmp_path / "new" / "page.html").exists()
    assert not (tmp_path / "run" / "report.html").exists()


@pytest.mark.parametrize("name", ["nothing", "."])
def test_a_folder_without_runs_is_refused_and_says_why(tmp_path, capsys, name):
    assert main(["report", str(tmp_path / name)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert "no results.json" in said.err or "not a folder" in said.err
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_ends_with_one(tmp_path, capsys):
    write_run(tmp_path / "run", RESULTS, extras=False)
    (tmp_path / "file").write_text("")
    assert main(["report", str(tmp_path / "run"), "--to", str(tmp_path / "file" / "page.html")]) == 1
    assert "file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        *((text, f"greater than or equal to 1; got {text}") for text in ("0", "-3")),
        ("nan", "a finite number"),
        ("soon", "a valid number; got 'soon'"),
    ],
)
def test_seconds_that_make_no_sense_are_refused(tmp_path, text, expected, capsys):
    assert main(["report", str(tmp_path), f"watch={text}"]) != 0
    assert f"watch must be {expected}" in capsys.readouterr().err


def test_a_missing_package_is_named_with_the_remedy(tmp_path, monkeypatch, capsys):
    write_run(tmp_path, RESULTS, extras=False)
    for name in [name for name in sys.modules if name.startswith(("hno.report.page", "hno.report.charts", "altair"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "altair", None)
    assert main(["report", str(tmp_path)]) == 1
    assert "needs the package altair: pip install " in capsys.readouterr().err


def test_watching_follows_the_sweep_and_leaves_a_page_at_rest(tmp_path, monkeypatch, capsys):
    page, seen = tmp_path / "report.html", []

    def sleep(seconds: float) -> None:
        seen.append((seconds, page.read_text()))
        if len(seen) == 2:
            raise KeyboardInterrupt
        write_run(tmp_path / "1", {**RESULTS, "seed": 1}, extras=False)

    write_run(tmp_path / "0", RESULTS, extras=False)
    monkeypatch.setattr(time, "sleep", sleep)
    assert main(["report", str(tmp_path), "watch=7"]) == 0
    assert [seconds for seconds, _ in seen] == [7.0, 7.0]
    assert ["1 run: 1 finished" in text for _, text in seen] == [True, False]
    assert "2 runs: 2 finished" in seen[1][1]
    assert all("Refreshes every 7 s" in text for _, text in seen)
    assert "Refreshes every" not in page.read_text()
    assert capsys.readouterr().out.splitlines()[-1] == str(page)


def test_a_run_that_goes_on_is_read_again(tmp_path):
    write_run(tmp_path / "0", {**RESULTS, "status": "running"}, extras=False)
    with claimed(tmp_path / "0" / LOCK):
        assert load(tmp_path).runs[0].status == "running"
    os.utime(tmp_path / "0" / "results.json", ns=(1, 1))
    write_run(tmp_path / "0", RESULTS, extras=False)
    assert load(tmp_path).runs[0].status == "finished"


def test_the_assets_lie_inside_the_package():
    spec = importlib.util.find_spec("hno.report")
    assert spec is not None
    assert spec.origin is not None
    assets = Path(spec.origin).parent / "assets"
    assert {path.suffix for path in assets.iterdir()} == {".j2", ".css", ".js", ".html"}
