"""Figures and tables for documents."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from hno.report import charts, vega
from hno.report.pictures import markdown, ratio_table, write_figures
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
    assert {path.name for path in written} == drawn | {"summary.md"}
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
    text = markdown(sweep, found)
    assert "| drone | sno / value / tanh | 1 | 150 | 3 | 2.00 % |" in text
    assert "3 of 150" in text
    assert "- 1: a \\| b &lt;i>" in text


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
    assert label in drawn(vega.svg(charts.heat_map(vega.inline([counts]))))


def kernel(condition, rank=8):
    return {"rows": 8, "cutoff": 1e-12, "rank": rank, "condition": condition, "effective_rank": 2.0, "curve": []}


def ratios(folder, *kernels):
    """Lines of the table of runs with name, activation, kernel and points."""
    for name, activation, found, points in kernels:
        section = [{"theta": [1.0, 1.0], "reason": None, "points": points, "kernel": found, "product": kernel(2.0)}]
        write_run(folder / name, results(activation, ntk=section), extras=False)
    table = ratio_table(load(folder).runs)
    return [dict(zip((column.title for column in table.columns), line, strict=True)) for line in table.texts]


@pytest.mark.parametrize(
    ("tanh", "sin", "ratio"),
    [
        (kernel(600.0), kernel(200.0), "3"),
        (kernel(9e11, rank=5), kernel(1e10), "> 100"),
        (kernel(1e10), kernel(9e11, rank=5), "< 0.01"),
        (kernel(1.0, rank=5), kernel(1.0, rank=5), "n/a"),
    ],
)
def test_ratios_of_condition_numbers_are_bounds_where_a_kernel_is_cut_off(tmp_path, tanh, sin, ratio):
    lines = ratios(tmp_path, ("0", "tanh", tanh, 4), ("1", "sin", sin, 4), ("2", "relu", kernel(50.0), 4))
    assert [line["kernel"] for line in lines] == ["J J'", "trunk times branch"]
    assert [line["tanh / sin"] for line in lines] == [ratio, "1"]
    assert lines[0]["tanh / relu"] != "n/a"


def test_several_runs_of_an_activation_are_told_apart(tmp_path):
    kernels = [("0", "tanh", 600.0, 4), ("1", "sin", 200.0, 4), ("2", "sin", 300.0, 4)]
    line, _ = ratios(
        tmp_path, *((name, activation, kernel(found), points) for name, activation, found, points in kernels)
    )
    assert (line["tanh / sin (1)"], line["tanh / sin (2)"]) == ("3", "2")


@pytest.mark.parametrize(
    "kernels",
    [
        [("0", "tanh", kernel(600.0), 4), ("1", "sin", kernel(200.0), 40)],
        [("0", "tanh", kernel(600.0), 4), ("1", "tanh", kernel(500.0), 4), ("2", "sin", kernel(200.0), 4)],
        [("0", "sin", kernel(200.0), 4)],
        [("0", "tanh", kernel(600.0), 4), ("1", "sin", "damaged", 4)],
    ],
)
def test_kernels_that_do_not_compare_have_no_ratio(tmp_path, kernels):
    assert ratios(tmp_path, *kernels) == []
