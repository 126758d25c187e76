"""The page of a search over settings."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from hno.report.page import render
from hno.report.runs import load
from hno.report.trials import points, table


def left(folder: Path, **changed: Any) -> Path:
    """The folder of a search of four trials, one of which was pruned, with the results of one job."""
    job = folder / "0_x"
    job.mkdir(parents=True)
    (job / "results.json").write_text(json.dumps({"status": "pruned", "reason": "hopeless", "table": []}))
    values = [[0.5, 1.0], None, [0.25, 2.0], [0.5, 2.0]]
    made = [
        {"number": k, "state": "finished" if found else "pruned", "values": found, "params": {"lr": 0.1 * k},
         "job": None, "reason": None} for k, found in enumerate(values)
    ]  # fmt: skip
    content = {
        "objectives": ["a", "b"],
        "axes": ["lr"],
        "best": [0, 2],
        "importance": None,
        "trials": made,
        "words": [],
    }
    (folder / "study.json").write_text(json.dumps({**content, **changed}))
    return folder


def test_a_page_shows_the_search(tmp_path: Path) -> None:
    sweep = load(left(tmp_path / "s"))
    assert sweep.study is not None
    found = points(sweep.study)
    assert [row["so_far"] for row in found["a"]] == [0.5, 0.5, 0.25, 0.25]
    assert [row["best"] for row in found["b"]] == [True, False, True, False]
    assert [row[0] for row in table(sweep.study).texts] == ["2", "0", "3"]
    page = render(sweep)
    assert 'id="search"' in page
    assert "4 trials: 3 finished, 1 pruned." in page
    assert "1 run: 0 finished, 1 pruned." in page
    damaged = load(left(tmp_path / "d", trials=3))
    assert damaged.study is None
    assert [entry.name for entry in damaged.skipped] == ["study.json"]
