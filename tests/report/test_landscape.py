"""The landscape in a real browser: it evaluates the controller as Python does, and says what it shows."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from hno.control import Feedback
from hno.evaluation.landscape import landscape
from hno.evaluation.page_script import script
from hno.export.page_program import answers_of_one_type, as_json, page_program
from hno.export.trace import in_double, points, traced
from hno.games import Game, make
from hno.operators import Architecture, Choice, ValueOperator, make_operator
from hno.report import landscapes
from hno.report.page import render, write_page
from hno.report.runs import load
from hno.types import Extremal, Status
from tests.fakes import fake_labels
from tests.report.folders import GRID5, make_results, write_run
from tests.report.test_browser import Browser, context, playwright, pytestmark  # noqa: F401  # a fixture and a mark

ASSETS = Path(landscapes.__file__).parent / "assets"
LANDSCAPE = "landscape.js"
TOLERANCE = 2e-3
"""Largest error of a graph in half precision, relative to the largest entry of the output."""


def small(game: str, function: str) -> ValueOperator:
    torch.manual_seed(0)
    parts = Architecture(Choice(function), Choice("deeponet", {"width": 16, "depth": 2}), Choice("tanh"))
    return make_operator(make(game), parts).requires_grad_(False)


def equilibria(game: Game, x0: Tensor, theta: Tensor, tau: float) -> Extremal:
    """Made-up ones at the time to go of a slice, of which the first was not found."""
    assert tau == game.horizon / 2
    status = [Status.STALLED, *[Status.CONVERGED] * (len(x0) - 1)]
    return fake_labels(game, theta[0].tolist(), len(x0), start=x0, status=status)


@pytest.fixture(scope="module")
def content() -> dict[str, Any]:
    return landscape(Feedback(small("narrow_road", "potential")), 5, equilibria)


def in_browser(page: Any, program: dict[str, Any], asked: dict[str, Tensor]) -> dict[str, Any]:
    """What the page's evaluator says, by name: shape and entries."""
    inputs = {name: {"shape": list(part.shape), "data": part.flatten().tolist()} for name, part in asked.items()}
    text = f"""([program, inputs, n]) => {{ {(ASSETS / "graph.js").read_text()}
        for (const input of Object.values(inputs)) input.data = Float64Array.from(input.data);
        return Object.fromEntries(Object.entries(graph(program)(inputs, n))
            .map(([name, {{ shape, data }}]) => [name, {{ shape, data: [...data] }}])); }}"""
    return page.evaluate(text, [program, inputs, len(asked["tau"])])


@pytest.mark.parametrize(
    ("game", "function"),
    [("narrow_road", "potential"), pytest.param("intersection", "value", marks=pytest.mark.slow)],
)
def test_the_page_evaluates_a_controller_as_python_does(context, content, game, function):  # noqa: F811
    operator = small(game, function)
    program = content["program"] if game == "narrow_road" else page_program(operator)
    asked = points(operator.game, 40, 3)
    asked["theta"] = asked["theta"][:1].expand(40, -1)
    wanted = answers_of_one_type(in_double(operator))(*asked.values())
    page = context.new_page()
    found = in_browser(page, json.loads(json.dumps(program)), asked)
    page.close()
    assert set(found) == set(wanted)
    for name, part in wanted.items():
        assert found[name]["shape"] == list(part.shape)
        off = np.abs(np.array(found[name]["data"]) - part.detach().numpy().ravel())
        assert off.max() < TOLERANCE * float(part.abs().max()), name


def test_every_operation_of_a_graph_is_computed_as_in_torch(context):  # noqa: F811
    """Those of which the controllers above need none, too."""

    def function(tau: Tensor, x: Tensor, theta: Tensor) -> dict[str, Tensor]:
        flat = x.flatten(1)
        place = flat[:, :2].abs().floor().long() % 3
        return {
            "sorted": flat.sort(-1, descending=True).values, "rising": x.sort(1).values, "argmax": x.argmax(-1),
            "gathered": flat.gather(1, place), "taken": flat[:, torch.tensor([3, 0, 0])], "least": flat.amin(-1),
            "product": theta.prod(-1), "remainder": flat.remainder(0.7), "floor": flat.floor(),
            "power": flat.abs().pow(1.3),
            "where": torch.where((flat > 1) & ~(flat > 3), flat.exp().log(), -flat.relu()),
            "angles": (flat / 200).asin() + (flat / 200).acos() + flat.atan() + (flat / 200).tan(),
            "turned": (x.transpose(1, 2) @ x).tanh(), "flipped": x.flip(1), "cat": torch.cat([theta, tau[:, None]], 1),
            "ends": torch.maximum(tau, theta[:, 0]) / torch.minimum(tau + 1, theta[:, 1]).sqrt(),
            "equal": (theta[:, 0] != theta[:, 1]).to(tau) + (tau == tau).to(tau),
        }  # fmt: skip

    asked = points(make("narrow_road"), 6, 1)
    program = as_json(traced(function, make("narrow_road"), 6))
    page = context.new_page()
    found = in_browser(page, json.loads(json.dumps(program)), asked)
    page.close()
    for name, part in function(*asked.values()).items():
        np.testing.assert_allclose(found[name]["data"], part.double().numpy().ravel(), rtol=1e-9, err_msg=name)


def run_with(folder: Path, content: dict[str, Any] | None, name: str = "one") -> Path:
    """A run and its landscape."""
    results = make_results("narrow_road", "sno", "tanh", 0, np.random.default_rng(0), GRID5[:1], landscape=LANDSCAPE)
    place = write_run(folder / name, results)
    if content is not None:
        (place / LANDSCAPE).write_text(script(content))
    return place


def opened(context, folder: Path) -> Browser:  # noqa: F811
    write_page(load(folder), folder / "report.html")
    found = Browser(context, (folder / "report.html").as_uri())
    found.page.locator("#landscape").scroll_into_view_if_needed()
    return found


def test_the_page_shows_values_equilibria_and_errors_from_a_file_beside_it(context, content, tmp_path):  # noqa: F811
    run_with(tmp_path, content)
    browser = opened(context, tmp_path)
    page = browser.page
    page.locator("#land-error canvas").wait_for()
    said = page.text_content("#land-said")
    assert "Evaluated in this page" in said
    assert "24 of 25 points have an equilibrium" in said
    assert page.locator("#land-shown option").all_text_contents()[:3] == ["W", "V1", "V2"]
    page.locator("#land-truth canvas").hover(position={"x": 120, "y": 80})
    browser.until("/^gap .* m, offset .* m: W -?[0-9.]+$/.test(document.querySelector('#land-at').textContent)")
    for label in ("V2", "∂W/∂v_1"):
        page.select_option("#land-shown", label=label)
    page.select_option("#land-across", "v_1")
    browser.until("document.querySelector('#land-truth-box').hidden")
    assert page.locator("#land-up option[value=v_1]").is_disabled()
    labels = page.locator("#land-sliders label").all_inner_texts()
    assert [text.split()[0] for text in labels] == ["τ", "θ1", "θ2", "px_1", "psi_1", "px_2", "psi_2", "v_2"]
    page.select_option("#land-level", index=1)
    page.locator("#land-sliders input").first.fill("0.5")
    page.click("#land-reset")
    browser.until("!document.querySelector('#land-truth-box').hidden")
    assert page.input_value("#land-across") == "gap"
    assert browser.said == []
    files = [url for url in browser.asked if url.startswith("file")]
    assert files == [browser.address, (tmp_path / "one" / LANDSCAPE).as_uri()]
    page.close()


def test_the_film_shows_the_slice_after_every_validation(context, content, tmp_path):  # noqa: F811
    size = 17 * 17
    shots = [{"step": step, "values": [float(-step - k) for k in range(size)]} for step in (10, 20, 30)]
    film = {"points": 17, "violation": [float(k - 100) for k in range(size)], "frames": shots}
    run_with(tmp_path, {**content, "film": film})
    browser = opened(context, tmp_path)
    page = browser.page
    page.locator("#land-learned canvas").wait_for()
    assert page.text_content("#land-film-step") == "step 30"
    page.select_option("#land-up", "v_2")
    page.locator("#land-film").fill("1")
    browser.until("document.querySelector('#land-said').textContent.includes('W after step 20, frame 2 of 3')")
    assert page.input_value("#land-up") == "offset"
    page.click("#land-reset")
    browser.until("document.querySelector('#land-said').textContent.includes('Evaluated in this page')")
    assert browser.said == []
    page.close()


def test_the_landscape_fits_a_phone(context, content, tmp_path):  # noqa: F811
    run_with(tmp_path, content)
    browser = opened(context, tmp_path)
    browser.page.set_viewport_size({"width": 390, "height": 900})
    browser.page.locator("#land-learned canvas").wait_for()
    browser.until("document.documentElement.scrollWidth === 390")  # charts are drawn again
    browser.page.close()


def test_without_a_graph_the_page_shows_pythons_values_and_says_so(context, content, tmp_path):  # noqa: F811
    run_with(tmp_path, {**content, "program": None, "reason": "UnsupportedError: aten.cumsum cannot be exported"})
    browser = opened(context, tmp_path)
    browser.page.locator("#land-error canvas").wait_for()
    assert "cannot evaluate the controller (UnsupportedError: aten.cumsum" in browser.page.text_content("#land-said")
    assert browser.page.locator("#land-sliders input").first.is_disabled()
    assert browser.page.locator("#land-across").is_disabled()
    assert browser.said == []
    browser.page.close()


def test_a_page_that_is_not_what_python_says_shows_pythons_values(context, content, tmp_path):  # noqa: F811
    wrong = {**content, "python": {**content["python"], "potential": [2.0 for _ in content["python"]["potential"]]}}
    run_with(tmp_path, wrong)
    browser = opened(context, tmp_path)
    browser.page.locator("#land-error canvas").wait_for()
    assert "more than 1 %" in browser.page.text_content("#land-said")
    browser.page.close()


def test_a_file_that_has_gone_is_named(context, content, tmp_path):  # noqa: F811
    place = run_with(tmp_path, content)
    write_page(load(tmp_path), tmp_path / "report.html")
    (place / LANDSCAPE).unlink()
    browser = Browser(context, (tmp_path / "report.html").as_uri())
    browser.page.locator("#landscape").scroll_into_view_if_needed()
    browser.until("document.querySelector('#land-said').textContent.includes('cannot be loaded')")
    assert "keep the folder of one beside this page" in browser.page.text_content("#land-said")
    browser.page.close()


@pytest.mark.parametrize(
    "text",
    [
        "document.title = 'mine';\n",
        "hnoLandscape({});document.title = 'mine';\n",
        "hnoLandscape({});\ndocument.title = 'mine'\nhnoLandscape({});\n",
        'hnoLandscape({"program":(document.title = 1)});\n',
        "hnoLandscape({}) || hnoLandscape({});\n",
        'hnoLandscape({"reason":"\u2028"});\n',
        "\ufeffhnoLandscape({});\n",
        'hnoLandscape({"players":2',
        "hnoLandscape({}",
        "hnoLandscape(" + "[" * 100_000 + ");\n",
        "",
    ],
    ids=range(11),
)
def test_a_script_that_says_more_than_numbers_is_not_loaded(tmp_path, text):
    """A page would run it, whoever wrote the folder."""
    run_with(tmp_path, None)
    place = tmp_path / "one"
    (place / LANDSCAPE).write_text(text, encoding="utf-8")
    (run,) = load(tmp_path).runs
    assert run.landscape is None
    assert any("no landscape: landscape.js is not hno's" in note for note in run.notes)
    assert LANDSCAPE not in json.dumps(landscapes.entries(load(tmp_path).runs, tmp_path))


def test_each_model_of_an_evaluation_has_its_own_landscape_or_none(tmp_path):
    results = make_results(
        "narrow_road", "sno", "tanh", 0, np.random.default_rng(0), GRID5[:1], landscape="landscape.js"
    )
    models = [{"landscape": "landscape.js"}, {}, {"landscape": "landscape2.js"}, {"landscape": "../../landscape.js"}]
    place = write_run(tmp_path / "one", results | {"models": models})
    for name in ("landscape.js", "landscape2.js"):
        (place / name).write_text(script({}))
    found = [run.landscape and run.landscape.name for run in load(tmp_path).runs]
    assert found == ["landscape.js", None, "landscape2.js", "landscape.js"]
    assert all(run.landscape is None or run.landscape.parent == place for run in load(tmp_path).runs)


def test_the_page_itself_holds_no_landscape_and_names_the_file_from_where_it_lies(content, tmp_path):
    for name in ("a b", "c"):
        run_with(tmp_path / "runs", content, name)
    run_with(tmp_path / "runs", None, "none")
    sweep = load(tmp_path / "runs")
    found = landscapes.entries(sweep.runs, tmp_path / "pages")
    assert [(entry["run"], entry["src"]) for entry in found] == [
        ("a b", "../runs/a%20b/landscape.js"),
        ("c", "../runs/c/landscape.js"),
    ]
    without = render(sweep._replace(runs=tuple(run.model_copy(update={"landscape": None}) for run in sweep.runs)))
    assert len(render(sweep)) - len(without) < 6000
    assert 'id="landscape"' not in without
