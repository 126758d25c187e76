"""`python -m hno.report` as people call it."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from hno.report.__main__ import main
from tests.report.folders import GRID5, make_results, write_run

RESULTS = make_results("drone", "sno", "tanh", 0, np.random.default_rng(0), GRID5[:2])


def test_the_page_lies_in_the_folder_and_its_path_is_printed(tmp_path, capsys):
    write_run(tmp_path, RESULTS)
    assert main([str(tmp_path)]) == 0
    assert capsys.readouterr().out.split() == [str(tmp_path / "report.html")]
    assert (tmp_path / "report.html").read_text().lstrip().startswith("<!doctype html>")


def test_out_chooses_the_file(tmp_path):
    write_run(tmp_path / "run", RESULTS)
    assert main([str(tmp_path / "run"), "--out", str(tmp_path / "new" / "page.html")]) == 0
    assert (tmp_path / "new" / "page.html").exists()
    assert not (tmp_path / "run" / "report.html").exists()


@pytest.mark.parametrize("name", ["nothing", "."])
def test_a_folder_without_runs_ends_with_one_and_says_why(tmp_path, capsys, name):
    assert main([str(tmp_path / name)]) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert "no results.json" in said.err or "not a folder" in said.err
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_ends_with_one(tmp_path, capsys):
    write_run(tmp_path / "run", RESULTS, extras=False)
    (tmp_path / "file").write_text("")
    assert main([str(tmp_path / "run"), "--out", str(tmp_path / "file" / "page.html")]) == 1
    assert "file" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["0", "-3", "nan", "soon"])
def test_seconds_that_make_no_sense_are_refused(tmp_path, text, capsys):
    with pytest.raises(SystemExit):
        main([str(tmp_path), "--watch", text])
    assert "--watch" in capsys.readouterr().err


def test_a_missing_package_is_named_with_the_remedy(tmp_path, monkeypatch, capsys):
    write_run(tmp_path, RESULTS, extras=False)
    for name in [name for name in sys.modules if name.startswith(("hno.report.page", "hno.report.charts", "altair"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "altair", None)
    assert main([str(tmp_path)]) == 1
    assert "altair: pip install 'hno[report]'" in capsys.readouterr().err


def test_watching_follows_the_sweep_and_leaves_a_page_at_rest(tmp_path):
    write_run(tmp_path / "0", RESULTS, extras=False)
    page = tmp_path / "report.html"
    command = [sys.executable, "-m", "hno.report", str(tmp_path), "--watch", "1"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=dict(os.environ))
    try:
        assert process.stdout is not None
        assert "up to date" in process.stdout.readline()
        assert "1 run:" in page.read_text()
        assert "Refreshes every" in page.read_text()
        write_run(tmp_path / "1", {**RESULTS, "seed": 1}, extras=False)
        deadline = time.monotonic() + 60
        while "2 runs:" not in page.read_text():
            assert time.monotonic() < deadline
            time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
    finally:
        process.kill()
        process.stdout.close()
    assert "Refreshes every" not in page.read_text()


def test_the_assets_lie_inside_the_package():
    spec = importlib.util.find_spec("hno.report")
    assert spec is not None
    assert spec.origin is not None
    assets = Path(spec.origin).parent / "assets"
    assert {path.suffix for path in assets.iterdir()} == {".j2", ".css", ".js"}
