"""The page: one file, bounded, the same for the same folder, and no text from a file becomes markup."""

from __future__ import annotations

import html
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hno.report import payload
from hno.report.further import SECTIONS, sections
from hno.report.page import LIMIT, embedded, render, write_page
from hno.report.parsing import episode
from hno.report.runs import load
from tests.report.folders import GRID5, GRID9, make_episode, make_results, row, write_run, write_sweep

HOSTILE = """</script><script>alert(1)</script><img src=x onerror=alert(1)>"'&{{ 7*7 }}<!--\u2028"""


class Page(HTMLParser):
    """Elements, texts and scripts of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.texts.append(data)

    @property
    def data(self) -> dict[str, Any]:
        return json.loads(next(text for text in self.texts if text.startswith("{") and '"charts"' in text))


@pytest.fixture(scope="module")
def small_page(small_sweep) -> str:
    return render(small_sweep)


def test_the_page_needs_nothing_but_itself(small_page):
    page = Page(small_page)
    for tag, attributes in page.elements:
        assert tag not in ("iframe", "object", "embed", "base", "img")
        assert not attributes.get("src")
        assert (attributes.get("href") or "#").startswith(("#", "data:"))
        assert not any(name.startswith("on") for name in attributes)
    assert "@import" not in small_page
    assert "url(" not in small_page.split("</style>")[0]


def test_the_same_folder_gives_the_same_page(small, small_page):
    assert render(load(small)) == small_page


def test_every_job_is_accounted_for(small_page):
    text = html.unescape(small_page)
    assert "20 runs: 18 finished, 1 failed, 1 unfinished" in text
    assert "DivergedError: the loss is not finite at step 350." in text
    assert "16 not begun" in text


def test_the_excess_cost_is_explained_as_it_is_taken(small_page):
    assert "Excess cost: median over types of (median joint cost above" in html.unescape(small_page)


def test_controls_have_names(small_page):
    page = Page(small_page)
    ids = {attributes.get("id") for _, attributes in page.elements}
    assert {"play", "scrub", "filters", "metric", "shown"} <= ids
    for tag, attributes in page.elements:
        if attributes.get("role") in ("img", "region"):
            assert attributes["aria-label"]
        if tag == "input" and attributes["type"] == "range":
            assert attributes["aria-label"]
        if tag == "button":
            assert attributes.get("type") in ("button", "reset")


def test_nothing_from_a_file_becomes_markup(tmp_path, small_page):
    results = make_results("drone", HOSTILE, HOSTILE, 0, np.random.default_rng(0), GRID5[:2])
    results |= {
        "label_statistics": [{HOSTILE: HOSTILE, "theta": [1, 1]}], "versions": {HOSTILE: HOSTILE},
        "robustness": [{"name": HOSTILE, HOSTILE: 1}], "seconds": {HOSTILE: 1.0},
        "config": {HOSTILE: HOSTILE, "seed": 0},
    }  # fmt: skip
    folder = write_run(tmp_path / "0", {**results, "game": HOSTILE})
    metrics = folder / "csv" / "metrics.csv"
    metrics.write_text(f'"{HOSTILE.replace(chr(34), chr(34) * 2)}",step\n1,2\n')
    write_run(tmp_path / "1", {**results, "seed": 1, "status": "failed", "reason": HOSTILE, "operator": "sno"})
    hostile = render(load(tmp_path))
    count = [len(re.findall(r"<script", text.split('id="data">')[0])) for text in (hostile, small_page)]
    assert count[0] == count[1]
    page = Page(hostile)
    assert {tag for tag, _ in page.elements} <= {tag for tag, _ in Page(small_page).elements}
    assert not any("onerror" in attributes for _, attributes in page.elements)
    assert page.data["curves"][0]["game"] == HOSTILE
    assert HOSTILE in page.data["curves"][0]["metrics"]
    assert HOSTILE in page.texts


def test_embedded_json_keeps_its_content_and_no_markup():
    content = {"text": HOSTILE, "number": 0.1}
    text = str(embedded(content))
    assert json.loads(text) == content
    assert not set(text) & set("<>&\u2028\u2029")
    with pytest.raises(ValueError, match="JSON"):
        embedded({"number": float("nan")})


@pytest.fixture(scope="module")
def big(tmp_path_factory) -> Path:
    return write_sweep(tmp_path_factory.mktemp("big") / "sweep", 200)


def test_two_hundred_runs_fit_and_say_what_is_left_out(big):
    sweep = load(big)
    text = render(sweep)
    assert len(text.encode()) <= LIMIT
    page = Page(text)
    total = sum(len(run.episodes) for run in sweep.runs)
    shown = len(page.data["episodes"])
    assert 200 < shown < total
    assert f"{shown:,} of {total:,} episodes are in this page" in text
    told = {entry["run"] for entry in page.data["episodes"] if entry["kind"] == "worst"}
    assert told == {run.name for run in sweep.runs if run.episodes}


def test_a_large_type_grid_fits_too(tmp_path):
    for seed in range(3):
        write_run(tmp_path / str(seed), make_results("drone", "sno", "tanh", seed, np.random.default_rng(seed), GRID9))
    text = render(load(tmp_path))
    assert len(text.encode()) <= LIMIT
    assert len(Page(text).data["maps"]["r0"]) == 81


def test_one_run_is_enough(tmp_path):
    folder = write_run(tmp_path / "alone", make_results("drone", "sno", "tanh", 0, np.random.default_rng(0)))
    text = render(load(folder))
    assert "1 run: 1 finished." in text
    assert "python train.py game=drone" in html.unescape(text)


def test_a_run_without_anything_but_results_is_shown(tmp_path):
    write_run(tmp_path, {"status": "running", "table": [], "schema": 2}, extras=False)
    text = render(load(tmp_path))
    assert "No run has a collision table yet." in text
    assert "unfinished" in text


def test_no_safe_start_is_no_zero(tmp_path):
    results = make_results("drone", "sno", "tanh", 0, np.random.default_rng(0)) | {"table": [row((1.0, 1.0), 0, 0)]}
    write_run(tmp_path, results, extras=False)
    text = render(load(tmp_path))
    assert "the collision rate is n/a" in text
    assert Page(text).data["maps"]["r0"] == [[[1.0, 1.0], 0, 0, 1, None, 0]]


def test_types_that_are_not_pairs_have_numbers_and_no_map(tmp_path):
    results = make_results("own", "sno", "tanh", 0, np.random.default_rng(0)) | {"table": [row((1.0, 2.0, 3.0), 1)]}
    write_run(tmp_path, results, extras=False)
    text = render(load(tmp_path))
    assert 'data-chart="heat"' not in text
    assert 'data-numbers="r0"' in text


@pytest.mark.parametrize("section", [{"name": "noise", "rate": 0.5, "interval": [0.1, 0.9]}, {"policy": {"rate": 0.5}}])
@pytest.mark.parametrize("nested", [False, True])
def test_sections_of_an_evaluation_are_tables(tmp_path, section, nested):
    results = make_results("drone", "sno", "tanh", 0, np.random.default_rng(0), GRID5[:1])
    content = {"table": [section], "interval": 4} if nested else [section]
    for key, heading in SECTIONS.items():
        write_run(tmp_path / key, results | {key: content}, extras=False)
        (run,) = load(tmp_path / key).runs
        found = sections(run)
        table = found[f"{heading}: table" if nested else heading]
        assert "50.00 %" in [cell.text for cell in table.rows[0].cells]
    text = render(load(tmp_path))
    assert all(heading in text for heading in SECTIONS.values())


def residual(theta: tuple[float, ...], region: str, **entries: Any) -> dict[str, Any]:
    return {
        "theta": list(theta),
        "region": region,
        "seen": False,
        "points": 100,
        "physical": 1.0,
        "scaled": 0.1,
    } | entries


def test_residuals_are_folded_by_region_and_weighted_by_points(tmp_path):
    rows = [
        residual((1.0, 1.0), "near", points=300, physical=2.0),
        residual((1.0, 2.0), "near", physical=6.0),
        residual((1.0, 3.0), "near", points=0, physical=None),
        residual((5.0, 5.0), "near", seen=True),
        residual((1.0, 1.0), "far"),
    ]
    results = make_results("drone", "sno", "tanh", 0, np.random.default_rng(0), GRID5[:1]) | {"residuals": rows}
    (run,) = load(write_run(tmp_path, results, extras=False)).runs
    table = sections(run)[SECTIONS["residuals"]]
    assert [[cell.text for cell in line.cells[:4]] for line in table.rows] == [
        ["near", "3 unseen", "400", "3"], ["near", "1 seen", "100", "1"], ["far", "1 unseen", "100", "1"],
    ]  # fmt: skip


def test_forty_large_evaluations_fit_and_say_what_is_left_out(tmp_path):
    rows = [{"name": f"{k} <&> {k}", **{f"number {c}": k / 7 for c in range(12)}} for k in range(405)]
    results = make_results("drone", "sno", "tanh", 0, np.random.default_rng(0), GRID9)
    for seed in range(40):
        write_run(tmp_path / str(seed), results | {"seed": seed, "robustness": rows}, episode_types=3)
    text = render(load(tmp_path))
    assert len(text.encode()) <= LIMIT
    assert "200 of 405 rows" in text
    assert re.search(r"Evaluations of \d+ of 40 runs", text)


def test_a_watched_page_says_so_and_others_do_not(small_sweep, small_page):
    assert Page(render(small_sweep, 5.0)).data["refresh"] == 5.0
    assert Page(small_page).data["refresh"] is None
    assert "Refreshes every" not in small_page


def test_a_page_is_written_whole_or_not_at_all(small_sweep, tmp_path, monkeypatch):
    target = tmp_path / "report.html"
    target.write_text("before")
    monkeypatch.setattr("pathlib.Path.write_text", lambda *_, **__: (_ for _ in ()).throw(OSError("full")))
    with pytest.raises(OSError, match="full"):
        write_page(small_sweep, target)
    assert target.read_bytes() == b"before"
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_episodes_survive_their_packing():
    found = episode(make_episode("drone", (1.0, 5.0), "worst", -0.1))
    packed = payload._paths(found.positions)
    unpacked = np.cumsum(np.array(packed), -1).transpose(2, 0, 1) / 100
    assert np.abs(unpacked - found.positions).max() <= 0.0051
    assert payload.gap(found).min() == pytest.approx(-0.1, abs=2e-3)


def test_curves_keep_their_ends_when_they_are_thinned(small_sweep):
    full = payload.learning_curves(small_sweep.runs, {})
    thin = payload.learning_curves(small_sweep.runs, {}, budget=20_000)
    assert payload.size(thin.content) <= 20_000 < payload.size(full.content)
    for some, every in zip(thin.content, full.content, strict=True):
        for name, (steps, _) in some["metrics"].items():
            assert [steps[0], steps[-1]] == [every["metrics"][name][0][0], every["metrics"][name][0][-1]]
