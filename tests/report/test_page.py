"""The page: one file, the same for the same folder, and no text from a file becomes markup."""

from __future__ import annotations

import html
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest

from hno.report import page_data
from hno.report import parts as page_parts
from hno.report.episode import closest, columns, episode
from hno.report.page import embedded, render, write_page
from hno.report.recipes import recipes
from hno.report.runs import load
from tests.report.folders import GRID5, GRID9, make_episode, make_results, row, write_run, write_sweep

HOSTILE = """</script><script>alert(1)</script><img src=x onerror=alert(1)>"'&{{ 7*7 }}<!--\u2028"""


def condition(name: str) -> dict[str, Any]:
    """A line of the robustness table."""
    types = [{"theta": [1.0, 5.0], "safe_starts": 200, "collisions": 100}]
    return row((1.0, 5.0), 100) | {"name": name, "condition": {"noise": 0.2}, "types": types}


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

    @property
    def episodes(self) -> list[dict[str, Any]]:
        """What is listed with what the parts of the runs hold of it."""
        data = self.data
        return [{**one, **data["parts"][one["of"]]["episodes"][one["place"]]} for one in data["episodes"]]


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
        "robustness": [condition(HOSTILE)], "seconds": {HOSTILE: 1.0},
        "config": {HOSTILE: HOSTILE, "seed": 0},
    }  # fmt: skip
    folder = write_run(tmp_path / "0", {**results, "game": HOSTILE})
    metrics = folder / "csv" / "metrics.csv"
    metrics.write_text(f'"{HOSTILE.replace(chr(34), chr(34) * 2)}",step\n1,2\n2,4\n')
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


def test_two_hundred_runs_say_which_episodes_are_left_out(big, monkeypatch):
    monkeypatch.setattr(page_parts, "EPISODES", 400)
    sweep = load(big)
    text = render(sweep)
    page = Page(text)
    total = sum(len(run.episodes) for run in sweep.runs)
    shown = len(page.data["episodes"])
    assert shown == 400 < total
    assert f"{shown:,} of {total:,} episodes are listed" in text
    told = {sweep.runs[entry["of"]].name for entry in page.data["episodes"] if entry["kind"] == "worst"}
    assert told == {run.name for run in sweep.runs if run.episodes}


def test_a_large_type_grid_has_all_its_cells(tmp_path):
    for seed in range(3):
        write_run(tmp_path / str(seed), make_results("drone", "sno", "tanh", seed, np.random.default_rng(seed), GRID9))
    assert len(Page(render(load(tmp_path))).data["maps"]["map0"]["cells"]) == 81


def test_one_run_is_enough(tmp_path):
    folder = write_run(tmp_path / "alone", make_results("drone", "sno", "tanh", 0, np.random.default_rng(0)))
    text = render(load(folder))
    assert "1 run: 1 finished." in text
    assert "python train.py game=drone" in html.unescape(text)


def test_a_run_without_anything_but_results_is_shown(tmp_path):
    write_run(tmp_path, {"status": "running", "table": []}, extras=False)
    text = render(load(tmp_path))
    assert "No run has a collision table yet." in text
    assert "unfinished" in text


def test_no_safe_start_is_no_zero(tmp_path):
    results = make_results("drone", "sno", "tanh", 0, np.random.default_rng(0)) | {"table": [row((1.0, 1.0), 0, 0)]}
    write_run(tmp_path, results, extras=False)
    text = render(load(tmp_path))
    assert "the collision rate is n/a" in text
    (cell,) = Page(text).data["maps"]["map0"]["cells"]
    assert (cell["safe_starts"], cell["rate"], cell["interval"]) == (0, None, None)
    assert "no safe start: rate n/a\nmedian excess cost n/a" in cell["tip"]


def test_types_that_are_not_pairs_have_numbers_and_no_map(tmp_path):
    results = make_results("own", "sno", "tanh", 0, np.random.default_rng(0)) | {"table": [row((1.0, 2.0, 3.0), 1)]}
    write_run(tmp_path, results, extras=False)
    text = render(load(tmp_path))
    assert 'data-chart="heat"' not in text
    (((name, _), *_),) = Page(text).data["maps"]["map0"]["rows"]
    assert name == "(1, 2, 3)"


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
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["report.html"]


def test_what_several_runs_show_lies_beside_the_page_and_of_one_run_in_it(small_sweep, tmp_path):
    """In files that hold numbers alone; those that no page needs any more go, whatever else lies there."""
    path, folder = tmp_path / "a b.html", tmp_path / "a b_files"
    write_page(small_sweep, path)
    kept = Page(path.read_text()).data["parts"]
    assert [part is None for part in kept] == [not (run.table or run.episodes) for run in small_sweep.runs]
    files = {unquote(part) for part in kept if part}
    assert {f"{folder.name}/{file.name}" for file in folder.iterdir()} == files
    whole = Page(render(small_sweep)).data["parts"]
    for part, content in zip(kept, whole, strict=True):
        if part:
            text = (tmp_path / unquote(part)).read_text()
            assert json.loads(text.removeprefix(page_parts.CALL).removesuffix(");\n")) == content
    (folder / "mine.js").write_text("")
    write_page(small_sweep._replace(runs=small_sweep.runs[:2]), path)
    assert len([*folder.iterdir()]) == 3
    write_page(small_sweep._replace(runs=small_sweep.runs[:1]), path)
    assert [file.name for file in folder.iterdir()] == ["mine.js"]
    assert Page(path.read_text()).data["parts"][0]["episodes"]


def test_the_player_gets_what_the_file_holds():
    found = episode(make_episode("drone", (1.0, 5.0), "worst", -0.1))
    shown = columns(found)
    assert np.abs(np.array(shown["p"]) - found.positions).max() <= 0.00051
    assert np.abs(np.array(shown["ghost"]) - found.label_positions).max() <= 0.00051
    gaps = (np.array(shown["distance"]) - shown["radius"]).tolist()
    assert min(gaps) == pytest.approx(-0.1, abs=2e-3)
    assert gaps.index(min(gaps)) == closest(found)


def test_the_headline_says_how_many_starts_count_and_why_the_others_do_not(tmp_path):
    results = make_results("drone", "sno", "tanh", 0, np.random.default_rng(0), GRID5[:1])
    counts = {"starts": 20, "safe_starts": 12, "inevitable": 5, "marginal": 2, "unsolved": 1, "collisions": 3}
    for number in range(2):
        table = [row((1.0, 1.0), 3, 12) | counts]
        write_run(tmp_path / str(number), results | {"table": table, "seed": number}, extras=False)
    said = (
        "24 of 40 starts count (2 seeds from the same starts); left out: 10 whose equilibrium collides, "
        "4 whose equilibrium passes closer than the clearance, 2 without a converged equilibrium."
    )
    assert said in Page(render(load(tmp_path))).texts


def test_a_single_run_has_no_furniture_of_a_sweep(tmp_path, small_page):
    write_run(tmp_path, make_results("drone", "sno", "tanh", 0, np.random.default_rng(0)))
    alone = Page(render(load(tmp_path)))
    ids = {attributes.get("id"): attributes for _, attributes in alone.elements}
    assert "recipes" not in ids
    assert "hidden" in ids["filters"]
    assert not any(attributes.get("data-chart") == "comparison" for _, attributes in alone.elements)
    assert not any("1 runs" in text or "1 types" in text for text in alone.texts)
    assert "recipes" in {attributes.get("id") for _, attributes in Page(small_page).elements}


def test_what_was_logged_once_is_no_curve(tmp_path):
    folder = write_run(tmp_path, make_results("drone", "sno", "tanh", 0, np.random.default_rng(0)))
    lines = (folder / "csv" / "metrics.csv").read_text().splitlines()
    lines = [lines[0] + ",seconds/labels", *(line + "," for line in lines[1:-1]), lines[-1] + ",3.0"]
    (folder / "csv" / "metrics.csv").write_text("\n".join(lines) + "\n")
    (curve,) = Page(render(load(tmp_path))).data["curves"]
    assert "seconds/labels" not in curve["metrics"]
    assert all(len(points) > 1 for points in curve["metrics"].values())


@pytest.mark.parametrize(("players", "radius"), [(1, None), (2, None), (3, 1.0)])
def test_episodes_of_any_number_of_players_and_without_a_distance_are_shown(tmp_path, players, radius):
    entry = make_episode("own", (1.0, 5.0), "worst", 0.3, frames=5)
    for name in ("positions", "label_positions"):
        entry[name] = [[*places, [0.0, 0.0]][-players:] if players != 2 else places for places in entry[name]]
    entry["radius"] = None if radius is None else [radius] * 5
    folder = write_run(tmp_path, make_results("own", "sno", "tanh", 0, np.random.default_rng(0), GRID5[:1]))
    (folder / "episodes.json").write_text(json.dumps({"episodes": [entry]}))
    (shown,) = Page(render(load(folder))).episodes
    assert len(shown["p"][0]) == players
    assert (shown["distance"] is None) == (players == 1)
    assert ("collision radius" in shown["said"]) == (radius is not None)


def test_branches_and_the_other_side_are_told(tmp_path):
    entries = [make_episode("own", (1.0, 5.0), kind, 0.3, frames=5) for kind in ("worst", "typical")]
    entries[0] |= {"branch": [0, 0, 1, 1, 1], "other_side": True}
    entries[1] |= {"branch": None, "other_side": False}
    folder = write_run(tmp_path, make_results("own", "sno", "tanh", 0, np.random.default_rng(0), GRID5[:1]))
    (folder / "episodes.json").write_text(json.dumps({"episodes": entries}))
    page = Page(render(load(folder)))
    worst, typical = page.episodes
    assert worst["branch"] == [0, 0, 1, 1, 1]
    assert typical["branch"] is None
    assert [(one.get("other_side", False), "other side" in one["said"]) for one in (worst, typical)] == [
        (True, True),
        (False, False),
    ]


def test_branches_of_another_length_than_the_path_are_refused():
    with pytest.raises(ValueError, match="arrays have shapes"):
        episode(make_episode("own", (1.0, 5.0), "worst", 0.3, frames=5) | {"branch": [0, 1]})


def test_conditions_of_start_states_are_explained(tmp_path):
    results = make_results("drone", "sno", "tanh", 0, np.random.default_rng(0), GRID5[:1])
    lines = [condition(name) | {"condition": {name: True}} for name in ("symmetric", "ties")]
    write_run(tmp_path, results | {"robustness": [condition("noise"), *lines]}, extras=False)
    texts = Page(render(load(tmp_path))).texts
    assert {"symmetric", "ties", "Condition symmetric: all players start in the same own state."} <= set(texts)
    ties = "Condition ties: the two cheapest equilibria of every start cost the same within 1 %"
    assert [text for text in texts if text.startswith("Condition ")][1:] == [f"{ties}; at most 25 per type."]


def test_curves_keep_their_ends_when_they_are_thinned(small_sweep, monkeypatch):
    full = page_data.learning_curves(recipes(small_sweep.runs), small_sweep.runs)
    monkeypatch.setattr(page_data, "POINTS", 4)
    thin = page_data.learning_curves(recipes(small_sweep.runs), small_sweep.runs)
    for some, every in zip(thin, full, strict=True):
        for name, points in some["metrics"].items():
            assert len(points) <= 4 < len(every["metrics"]["loss/total"])
            assert [points[0], points[-1]] == [every["metrics"][name][0], every["metrics"][name][-1]]
