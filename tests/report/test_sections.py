"""Sections of an evaluation, with the columns that the terminal shows."""

from __future__ import annotations

import html
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hno.evaluation.sections import sections
from hno.report.page import render
from hno.report.runs import load
from hno.report.tables import SectionTable, section_tables
from tests.report.folders import GRID5, make_results, write_run
from tests.report.test_page import condition

RESIDUALS = [
    {"theta": [1.0, 1.0], "seen": seen, "region": region, "points": points, "physical": physical, "scaled": 0.1,
     "tau": [0.0, 1.5, 3.0], "points_by_tau": [points, 0], "physical_by_tau": [physical, None],
     "scaled_by_tau": [0.1, None]}
    for region, seen, points, physical in (
        ("near", False, 300, 2.0), ("near", False, 100, 6.0), ("near", True, 100, 1.0), ("far", False, 100, 1.0)
    )
]  # fmt: skip
KERNEL = {"rows": 8, "cutoff": 1e-12, "rank": 8, "condition": 600.0, "effective_rank": 2.0, "curve": [[1, 5.0]]}
CONTENT = {
    "robustness": [condition("noise")],
    "residuals": RESIDUALS,
    "ntk": [{"theta": [1.0, 1.0], "reason": None, "points": 4, "block": 4, "kernel": KERNEL, "product": KERNEL}],
}


def shown(folder: Path, **content: Any) -> tuple[list[SectionTable], str]:
    results = make_results("drone", "sno", "tanh", 0, np.random.default_rng(0), GRID5[:1])
    sweep = load(write_run(folder, results | content, extras=False))
    return section_tables(sweep.runs[0]), html.unescape(render(sweep))


@pytest.mark.parametrize("name", CONTENT)
def test_a_section_has_the_columns_of_the_terminal(tmp_path: Path, name: str) -> None:
    (found,), text = shown(tmp_path, **{name: CONTENT[name]})
    section = sections.get(name)()
    assert found.heading == section.heading
    assert found.table.texts == [
        [column.format(line.get(column.name)) for column in section.columns] for line in section.rows(CONTENT[name])
    ]
    assert all(entry in text for entry in (section.heading, *(column.title for column in section.columns)))
    assert all(cell in text for line in found.table.texts for cell in line)


def test_a_rate_is_a_percentage(tmp_path: Path) -> None:
    (found,), _ = shown(tmp_path, robustness=[condition("noise")])
    assert "50.00 %" in found.table.texts[0]


def test_residuals_are_folded_by_region_and_weighted_by_points(tmp_path: Path) -> None:
    (found,), _ = shown(tmp_path, residuals=RESIDUALS)
    lines = [line for line in found.table.texts if line[0] == "near"]
    assert any("400" in line and "3" in line for line in lines)
    assert len(found.table.rows) == 3


@pytest.mark.parametrize("content", [[{"foreign": 1}], {"foreign": 1}, "nonsense", 3])
def test_a_damaged_section_is_named_and_costs_nothing_else(tmp_path: Path, content: Any) -> None:
    (found,), text = shown(tmp_path, robustness=content)
    assert "its entry in results.json is damaged" in found.remarks[0]
    assert "1 run: 1 finished." in text
