from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from hno.cli import pages
from hno.report.runs import load
from tests.report.folders import make_results, write_run


def test_the_page_lies_in_the_folder(tmp_path: Path) -> None:
    write_run(tmp_path / "run", make_results("narrow_road", "sno", "tanh", 0, np.random.default_rng(0)), extras=False)
    assert pages.write(tmp_path / "run") == f"Page: {tmp_path / 'run' / 'report.html'}"
    assert "<html" in (tmp_path / "run" / "report.html").read_text()
    assert len(load(tmp_path).runs) == 1


def test_a_missing_package_or_a_folder_without_runs_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "could not be written" in pages.write(tmp_path)
    write_run(tmp_path / "a run", make_results("narrow_road", "sno", "tanh", 0, np.random.default_rng(0)), extras=False)
    for name in [name for name in sys.modules if name.startswith(("hno.report.page", "hno.report.charts", "altair"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "altair", None)
    line = pages.write(tmp_path / "a run")
    assert "needs the package altair: pip install altair jinja2 pillow vl-convert-python" in line
    assert f"hno report '{tmp_path / 'a run'}'" in line
    assert not (tmp_path / "a run" / "report.html").exists()
