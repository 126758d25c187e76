"""A results.json of somebody else, opened through the page."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hno.report.page import render
from hno.report.runs import NoRunsError, load
from tests.report.folders import make_results

SCRIPTS = (
    "<script>document.title='ran'</script>",
    "</script><script>document.title='ran'</script>",
    '"><img src=x onerror="document.title=\'ran\'">',
    "javascript:document.title='ran'",
    "<!--<script>",
    "{{ 7 * 7 }}{% raw %}",
    "\u2028</SCRIPT ><svg onload=document.title='ran'>",
)
TYPES = ((1.0, 1.0), (1.0, 5.0))


def results() -> dict[str, Any]:
    return make_results("narrow_road", "sno", "sin", 0, np.random.default_rng(0), TYPES)


def page_of(folder: Path, content: Any) -> str | None:
    """The page about a results.json of any content; None where it is refused in our own words."""
    folder.mkdir(parents=True, exist_ok=True)
    text = content if isinstance(content, bytes) else json.dumps(content).encode()
    (folder / "results.json").write_bytes(text)
    try:
        return render(load(folder))
    except NoRunsError:
        return None


def replaced(content: Any, text: str) -> Any:
    """Every text and every free key with a script in it."""
    if isinstance(content, dict):
        return {key: replaced(entry, text) for key, entry in content.items()}
    if isinstance(content, list):
        return [replaced(entry, text) for entry in content]
    return content + text if isinstance(content, str) else content


def elements(page: str) -> list[str]:
    """What begins an element, outside of scripts, styles and data."""
    bare = re.sub(r"<(script|style)\b.*?</\1>", r"<\1>", page, flags=re.DOTALL)
    return [*re.findall(r"<(?:script|img|svg|iframe)\b[^>]*", bare), *re.findall(r"(?:href|src|on\w+)=\"[^\"#]*", bare)]


@pytest.mark.parametrize("script", SCRIPTS)
def test_nothing_in_results_becomes_markup(tmp_path: Path, script: str) -> None:
    usual = page_of(tmp_path / "run", results())
    hostile = replaced(results(), script) | {"status": "finished" + script, script: script, "reason": script}
    hostile["config"] = {script: script, "_target_": f"os.system{script}", "nested": {"_target_": script}}
    hostile["versions"], hostile["metrics"] = {script: script}, {script: 1.0}
    hostile["label_statistics"] = [{"theta": [1, 1], script: script}]
    found = page_of(tmp_path / "hostile", hostile)
    assert usual is not None
    assert found is not None
    ours = [element for element in elements(found) if "data-" not in element]
    assert ours == [element for element in elements(usual) if "data-" not in element]
    assert not re.search(r"<(img|svg)[^>]*(onerror|onload)", found)
    assert "<" not in script or script not in found


def test_a_configuration_is_text_that_nobody_instantiates(tmp_path: Path) -> None:
    canary = tmp_path / "canary"
    content = results()
    content["config"] = {"_target_": "pathlib.Path.touch", "_args_": [str(canary)], "game": {"_target_": "os.mkdir"}}
    page = page_of(tmp_path / "run", content)
    assert page is not None
    assert "pathlib.Path.touch" in page
    assert not canary.exists()


@pytest.mark.parametrize("depth", [200, 900, 5_000, 100_000])
@pytest.mark.parametrize("place", ["config", "metrics", "table", "rounds", "label_statistics", None])
def test_deep_nesting_is_shown_or_refused(tmp_path: Path, depth: int, place: str | None) -> None:
    deep = '{"a":' * depth + "1" + "}" * depth
    whole = json.dumps(results() | ({} if place is None else {place: "HERE"}))
    text = deep if place is None else whole.replace('"HERE"', deep)
    limit = sys.getrecursionlimit()
    page_of(tmp_path, text.encode())
    assert sys.getrecursionlimit() == limit


@pytest.mark.parametrize("models", [True, [None], "text", {"a": 1}, 3])
def test_models_that_are_no_list_of_objects_are_refused(tmp_path: Path, models: object) -> None:
    assert page_of(tmp_path, results() | {"models": models}) is None


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.sampled_from(SCRIPTS),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)
SECTIONS = ("table", "robustness", "rounds", "online", "ntk", "residuals", "models", "comparison", "episodes")


def read_at_random(folder: Path, cases: int) -> int:
    """So many random results.json; how many have a page. Any error but our own fails."""
    known, shown = results(), 0
    names = st.sampled_from([*known, *SECTIONS]) | st.text(max_size=5)
    row = st.dictionaries(st.sampled_from([*known["table"][0]]), JSON, max_size=3)
    content = st.one_of(
        st.dictionaries(names, JSON, min_size=1, max_size=3).map(lambda changed: known | changed),
        row.map(lambda changed: known | {"table": [known["table"][0] | changed, known["table"][1]]}),
        st.tuples(st.sampled_from(SECTIONS), st.lists(row, max_size=2)).map(lambda one: known | {one[0]: one[1]}),
        JSON,
        st.binary(max_size=60),
        st.integers(0, 400).map(lambda size: json.dumps(known).encode()[:size]),
    )

    @settings(max_examples=cases, deadline=None, derandomize=True, database=None)
    @given(content=content)
    def check(content: Any) -> None:
        nonlocal shown
        page = page_of(folder, content)
        shown += page is not None
        assert page is None or not any(script in page for script in SCRIPTS if "<" in script)

    check()
    return shown


def test_random_results_are_shown_or_refused(tmp_path: Path) -> None:
    read_at_random(tmp_path, 40)


@pytest.mark.slow
def test_ten_thousand_random_results_are_shown_or_refused(tmp_path: Path) -> None:
    print(f"10000 cases: random results.json, of which {read_at_random(tmp_path, 10_000)} have a page")
