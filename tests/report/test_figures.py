"""Figures and tables for documents."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from hno.report import charts, vega
from hno.report.condition_numbers import condition_table
from hno.report.figures import markdown, summary, write_figures
from hno.report.recipes import by_type, recipes
from hno.report.records import type_row
from hno.report.runs import load
from tests.report.folders import GRID5, make_results, row, write_run


def results(activation="tanh", **entries):
    return make_results("drone", "sno", activation, 0, np.random.default_rng(0), GRID5) | entries


def test_a_figure_of_every_kind_is_drawn_twice(tmp_path):
    write_run(tmp_path / "run", results())
    written = write_figures(load(tmp_path / "run"), tmp_path / "figures")
    views = [f"encounter_drone_{kind}_{view}" for kind in ("worst", "typical") for view in ("top", "side")]
    drawn = {
        f"{name}.{suffix}" for name in ("collisions_drone", "comparison_drone", *views) for suffix in ("svg", "png")
    }
    assert {path.name for path in written} == drawn | {"summary.md", "summary.json"}
    for path in written:
        assert path.stat().st_size > 0
        if path.suffix == ".svg":
            assert ET.parse(path).getroot().tag.endswith("svg")
    text = (tmp_path / "figures" / "collisions_drone.svg").read_text()
    assert "framed: types with training labels" in text


def test_the_summary_repeats_the_counts(tmp_path):
    table = [row((1.0, 1.0), 3, 100), row((5.0, 5.0), 0, 50)]
    write_run(tmp_path / "0", results(table=table), extras=False)
    write_run(tmp_path / "1", results(table=[], status="failed", reason="a | b\n<i>", seed=1), extras=False)
    sweep = load(tmp_path)
    found = recipes(sweep.runs)
    content = json.loads(summary(sweep, found))
    (recipe,) = content["recipes"]
    assert (recipe["collisions"], recipe["safe_starts"], recipe["failed"]) == (3, 150, 1)
    assert recipe["types"][0]["theta"] == [1.0, 1.0]
    assert content["missing"][0]["reason"] == "a | b\n<i>"
    text = markdown(sweep, found)
    assert "| drone | sno / tanh | 1 | 150 | 3 | 2.00 % |" in text
    assert "3 of 150" in text


def drawn(texts):
    return [text for text in ET.fromstring(texts).itertext() if text.strip()]


def test_figures_show_their_counts(tmp_path):
    table = [row((1.0, 1.0), 3, 100), row((5.0, 5.0), 0, 50)]
    for operator in ("hno", "sno"):
        write_run(tmp_path / operator, results(table=table, operator=operator), extras=False)
    write_figures(load(tmp_path), tmp_path / "figures")
    comparison, maps = (
        drawn((tmp_path / "figures" / f"{name}_drone.svg").read_text()) for name in ("comparison", "collisions")
    )
    assert comparison.count("3 of 150") == 2
    assert maps.count("50 to 100 safe starts per type") == 2
    assert maps.count("rate") == 1


@pytest.mark.parametrize(
    ("collisions", "starts", "label"), [(0, 9, "0"), (1, 10_000, "<0.1"), (1, 1000, "0.1"), (1, 2, "50"), (0, 0, "n/a")]
)
def test_a_cell_never_rounds_a_collision_away(collisions, starts, label):
    (counts,) = by_type([type_row(row((1.0, 1.0), collisions, starts))])
    assert label in drawn(vega.svg(charts.heat_map(vega.inline([counts._asdict()]))))


def kernel(condition, rank=8):
    return {"rows": 8, "cutoff": 1e-12, "rank": rank, "condition": condition, "effective_rank": 2.0, "curve": []}


@pytest.mark.parametrize(
    ("tanh", "sin", "ratio"),
    [
        (kernel(600.0), kernel(200.0), "3"),
        (kernel(9e11, rank=5), kernel(1e10), "> 100"),
        (kernel(1e10), kernel(9e11, rank=5), "< 0.01"),
        (kernel(1.0, rank=5), kernel(1.0, rank=5), "n/a"),
        (kernel(600.0), None, "n/a"),
    ],
)
def test_ratios_of_condition_numbers_are_bounds_where_a_kernel_is_cut_off(tmp_path, tanh, sin, ratio):
    for activation, found in (("tanh", tanh), ("sin", sin), ("relu", kernel(50.0))):
        section = [{"theta": [1.0, 1.0], "reason": None, "points": 4, "kernel": found, "product": None}]
        write_run(tmp_path / activation, results(activation, ntk=section), extras=False)
    table = condition_table(load(tmp_path).runs)
    (line,) = table.rows
    cells = dict(zip((column.title for column in table.columns), table.cells(line), strict=True))
    cells = {title: text for title, (text, _) in cells.items()}
    assert cells["kernel"] == "J J'"
    assert cells.get("tanh / sin", "n/a") == ratio
    assert cells["tanh / relu"] != "n/a"


def test_kernels_of_different_points_or_runs_are_lines_of_their_own(tmp_path):
    kernels = [("0", "tanh", 600.0, 4), ("1", "sin", 200.0, 40), ("2", "sin", 300.0, 4), ("3", "sin", 100.0, 4)]
    for name, activation, condition, points in kernels:
        section = [{"theta": [1.0, 1.0], "points": points, "kernel": kernel(condition), "product": None}]
        write_run(tmp_path / name, results(activation, ntk=section), extras=False)
    table = condition_table(load(tmp_path).runs)
    lines = [dict(zip((column.title for column in table.columns), line, strict=True)) for line in table.texts]
    shown = [[line[name] for name in ("points", "run", "tanh", "sin", "tanh / sin")] for line in lines]
    assert shown == [["4", "2", "600", "300", "2"], ["4", "3", "600", "100", "6"], ["40", "", "n/a", "200", "n/a"]]
