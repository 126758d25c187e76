"""The page in a real browser: it works, asks nobody for anything, and says nothing on the console."""

from __future__ import annotations

import json
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote, urlparse

import numpy as np
import pytest

from hno.report.page import write_page
from hno.report.runs import load
from tests.report.folders import GRID5, make_episode, make_results, write_run

playwright = pytest.importorskip("playwright.sync_api", reason="needs the package playwright")
CHROMIUM = shutil.which("chromium")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Debian's package chromium")

ARGUMENTS = (
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
)  # fmt: skip


class Browser:
    """An open page, with what it said and asked for."""

    def __init__(self, context, address: str) -> None:
        self.page = context.new_page()
        self.said: list[str] = []
        self.asked: list[str] = []
        self.page.on("console", lambda message: self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.address = address
        self.page.goto(address)

    def rows(self, section: str) -> list[list[str]]:
        """Cells of the rows that are shown."""
        script = """section => [...document.querySelectorAll(`#${section} tbody tr`)].filter(row => row.offsetParent)
            .map(row => [...row.cells].map(cell => cell.textContent))"""
        return self.page.evaluate(script, section)

    def shown(self, selector: str) -> int:
        return self.page.locator(f"{selector}:visible").count()

    def until(self, expression: str, seconds: float = 60) -> None:
        """Wait for a condition; the page's security policy keeps Playwright from doing so inside."""
        deadline = time.monotonic() + seconds
        while not self.page.evaluate(expression):
            assert time.monotonic() < deadline, f"never: {expression}"
            time.sleep(0.02)

    def meet(self, title: str = "") -> None:
        """Look at the player, or at one of its episodes, until it is drawn."""
        self.page.locator("#player").scroll_into_view_if_needed()
        if title:
            self.page.select_option("#episode", label=title)
        run = json.dumps(title.split(" · ")[0])
        self.until("document.querySelector('#clock').textContent !== ''")
        self.until(f"document.querySelector('#said').textContent.includes({run})")

    def filter(self, **choices: str) -> None:
        for name, value in choices.items():
            self.page.select_option(f"#filters select[name={name}]", value)


@pytest.fixture(scope="module")
def address(small, tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("page") / "report.html"
    write_page(load(small), path)
    return path.as_uri()


@pytest.fixture(scope="module")
def context(tmp_path_factory):
    with playwright.sync_playwright() as started:
        opened = started.chromium.launch_persistent_context(
            tmp_path_factory.mktemp("profile"), executable_path=CHROMIUM, args=list(ARGUMENTS), headless=True
        )
        opened.set_default_timeout(60_000)
        yield opened
        opened.close()


@pytest.fixture
def browser(context, address) -> Iterator[Browser]:
    opened = Browser(context, address)
    yield opened
    assert opened.said == []
    assert {url.split(":")[0] for url in opened.asked} <= {"file", "data"}
    beside = opened.address.removesuffix(".html") + "_files/"
    assert all(url == opened.address or url.startswith((beside, "data:")) for url in opened.asked)
    opened.page.close()


def test_everything_is_drawn_without_a_word_or_a_request(browser):
    page = browser.page
    for chart in ("heat", "comparison", "curves"):
        plot = page.locator(f"[data-chart={chart}]:visible").first
        plot.scroll_into_view_if_needed()
        plot.locator("svg, canvas").wait_for()
    browser.meet()
    page.locator("#top canvas").wait_for(state="attached")
    page.locator("#strips svg").first.wait_for(state="attached")


def test_filters_hide_what_does_not_match_and_live_in_the_address(browser):
    assert len(browser.rows("runs")) == 20
    browser.filter(game="drone", operator="sno")
    assert {tuple(row[2:4]) for row in browser.rows("runs")} == {("drone", "sno")}
    assert {row[0] for row in browser.rows("recipes")} == {"drone"}
    assert browser.shown(".game") == 1
    assert browser.shown(".map") == 3
    assert "of 20 runs" in browser.page.inner_text("#matching")
    browser.page.reload()
    assert len(browser.rows("runs")) == 3
    browser.page.click("#filters button[type=reset]")
    browser.until("document.querySelector('#matching').textContent === '20 runs'")


def test_what_is_learned_is_a_filter_of_its_own(context, tmp_path):
    for name in ("potential", "value"):
        results = make_results("drone", "sno", "tanh", 0, np.random.default_rng(0), GRID5[:2], function=name)
        write_run(tmp_path / name, results)
    write_page(load(tmp_path), tmp_path / "report.html")
    opened = Browser(context, (tmp_path / "report.html").as_uri())
    assert [row[1] for row in opened.rows("recipes")] == ["sno / potential / tanh", "sno / value / tanh"]
    opened.filter(function="value")
    assert [row[0] for row in opened.rows("runs")] == ["value"]
    assert [row[1] for row in opened.rows("recipes")] == ["sno / value / tanh"]
    opened.page.reload()
    assert [row[0] for row in opened.rows("runs")] == ["value"]
    assert opened.said == []
    opened.page.close()


def test_a_seed_shows_single_runs_in_place_of_pooled_ones(browser):
    pooled = browser.page.locator(".map:visible").first.text_content()
    browser.filter(seed="0", game="narrow_road")
    assert "seed 0" in browser.page.locator(".map:visible").first.text_content()
    assert "seed 0" not in pooled


def test_a_column_sorts_by_value_with_missing_numbers_last(browser):
    head = browser.page.locator("#runs th button", has_text="collisions")
    for order, sign in (("ascending", 1), ("descending", -1)):
        head.click()
        assert head.locator("..").get_attribute("aria-sort") == order
        texts = [row[9] for row in browser.rows("runs")]
        numbers = [int(text.replace(",", "")) for text in texts if text != "n/a"]
        assert numbers == sorted(numbers, key=lambda number: sign * number)
        assert texts[-2:] == ["n/a", "n/a"]


def test_the_animation_plays_and_pauses(browser):
    page = browser.page
    browser.meet()
    page.select_option("#speed", "2")
    page.click("#play")
    assert page.get_attribute("#play", "aria-label") == "Pause"
    browser.until("Number(document.querySelector('#scrub').value) > 0.3")
    browser.until("document.querySelector('#play').getAttribute('aria-label') === 'Play'")
    assert page.input_value("#scrub") == page.get_attribute("#scrub", "max")


def pixels(page, name: str, selector: str = "#top canvas") -> int:
    """How many pixels of the view have a colour of the page, or nearly so."""
    script = """([selector, name]) => {
        const canvas = document.querySelector(selector), probe = document.createElement('canvas').getContext('2d');
        probe.fillStyle = getComputedStyle(document.documentElement).getPropertyValue(`--${name}`);
        probe.fillRect(0, 0, 1, 1);
        const want = probe.getImageData(0, 0, 1, 1).data;
        const copy = Object.assign(document.createElement('canvas'), {width: canvas.width, height: canvas.height});
        const read = copy.getContext('2d', {willReadFrequently: true});
        read.drawImage(canvas, 0, 0);
        const all = read.getImageData(0, 0, canvas.width, canvas.height).data;
        let count = 0;
        for (let k = 0; k < all.length; k += 4)
            count += all[k + 3] > 60 && [0, 1, 2].every((c) => Math.abs(all[k + c] - want[c]) < 30);
        return count;
    }"""
    return page.evaluate(script, [selector, name])


def move_to(page, time: float) -> None:
    page.evaluate(
        """time => { const scrub = document.querySelector('#scrub');
        scrub.value = time; scrub.dispatchEvent(new Event('input')); }""",
        time,
    )


def titles(page) -> list[str]:
    return page.locator("#episode option").all_text_contents()


def test_discs_are_red_exactly_in_a_collision(browser):
    page = browser.page
    browser.meet(next(title for title in titles(page) if "collision" in title))
    move_to(page, 0)
    assert pixels(page, "danger") == 0
    move_to(page, 1.5)
    assert pixels(page, "danger") > 50


def test_between_frames_players_move_on(browser):
    """Sixty times a second: the picture of two times that lie between the same two frames differs."""
    page = browser.page
    browser.meet()
    shots = []
    for time_of in (0.901, 0.915):
        move_to(page, time_of)
        shots.append(page.evaluate("document.querySelector('#top canvas').toDataURL()"))
    assert shots[0] != shots[1]


def test_a_cell_of_a_heat_map_opens_its_episodes_and_the_address_keeps_the_view(browser):
    page = browser.page
    card = page.locator(".map:visible").first
    card.scroll_into_view_if_needed()
    card.locator("svg").wait_for()
    cell = card.locator(".mark-rect path").first
    cell.scroll_into_view_if_needed()
    cell.click(force=True)
    browser.until("document.querySelector('#types').value !== ''")
    theta = page.input_value("#types")
    assert all(f" {theta} " in title for title in titles(page))
    page.click("#next")
    chosen = page.locator("#episode option:checked").text_content()
    browser.meet(chosen)
    move_to(page, 0.75)
    page.reload()
    assert page.locator("#episode option:checked").text_content() == chosen
    assert page.input_value("#types") == theta
    browser.meet()
    browser.until("document.querySelector('#clock').textContent.startsWith('0.75 s')")


def test_two_policies_from_one_start_are_drawn_over_each_other(context, tmp_path):
    for number in range(2):
        results = make_results("lane_change", "sno", "tanh", number, np.random.default_rng(0), GRID5[:1])
        folder = write_run(tmp_path / f"run_{number}", results)
        entry = make_episode("lane_change", (1.0, 1.0), "typical", 0.3 + number, frames=9) | {"start": "same/3"}
        scene = {"bodies": [[4.5, 1.8], [4.5, 1.8]], "roads": [{"axis": 0, "edges": [0, 8], "marks": [4]}]}
        scene |= {"players": ["left one", "right one"], "note": "Bodies are drawn for the eye."}
        (folder / "episodes.json").write_text(json.dumps({"episodes": [entry], "scene": scene}))
    write_page(load(tmp_path), tmp_path / "report.html")
    opened = Browser(context, (tmp_path / "report.html").as_uri())
    assert opened.page.locator("#beside option").all_text_contents() == ["nothing", "run_1"]
    opened.meet()
    assert "left one, θ = 1" in opened.page.text_content("#who")
    assert "Bodies are drawn for the eye." in opened.page.text_content("#drawn")
    alone = opened.page.evaluate("document.querySelector('#top canvas').toDataURL()")
    opened.page.select_option("#beside", label="run_1")
    beside = "document.querySelector('#said').textContent.includes('Beside it: run_1')"
    opened.until(beside)
    assert opened.page.evaluate("document.querySelector('#top canvas').toDataURL()") != alone
    opened.page.reload()
    opened.meet()
    opened.until(beside)
    assert opened.said == []
    opened.page.close()


def test_a_page_that_was_moved_without_its_folder_says_so(context, address, tmp_path):
    moved = shutil.copy(Path(unquote(urlparse(address).path)), tmp_path / "report.html")
    opened = Browser(context, moved.as_uri())
    opened.page.locator("#episodes").scroll_into_view_if_needed()
    opened.until(
        "document.querySelector('#said').textContent.includes('keep the folder report_files beside this page')"
    )
    assert opened.shown("#top") == 0
    shutil.copytree(Path(unquote(urlparse(address).path)).parent / "report_files", tmp_path / "report_files")
    opened.page.click("#next")
    opened.until("document.querySelector('#said').textContent.includes('Lost against the equilibrium')")
    assert opened.shown("#top") == 1
    opened.page.close()


def test_the_clock_says_which_branch_is_played(context, tmp_path):
    folder = write_run(tmp_path, make_results("drone", "sno", "tanh", 0, np.random.default_rng(0), GRID5[:1]))
    entry = make_episode("drone", (1.0, 1.0), "worst", 0.3, frames=5)
    episodes = [entry | {"branch": [0, 0, 1, 1, 1], "other_side": True}, entry | {"kind": "typical"}]
    (folder / "episodes.json").write_text(json.dumps({"episodes": episodes}))
    write_page(load(folder), tmp_path / "report.html")
    opened = Browser(context, (tmp_path / "report.html").as_uri())
    opened.meet()
    opened.until("document.querySelector('#clock').textContent === '1.50 s, branch 1'")
    assert "Passes on the other side than the equilibrium." in opened.page.text_content("#said")
    opened.page.click("#next")
    opened.until("document.querySelector('#clock').textContent === '1.50 s'")
    assert "other side" not in opened.page.text_content("#said")
    assert opened.said == []
    opened.page.close()


def test_a_print_has_what_nobody_has_looked_at(browser):
    """Every heat map of the sweep, the encounter and the curves are drawn for a sheet before it is printed."""
    page = browser.page
    assert page.locator(".map svg").count() < page.locator(".map[data-level=recipe]").count()
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    shown = page.evaluate(
        """() => [...document.querySelectorAll('[data-chart]')].filter((host) => host.clientWidth)
            .map((host) => Boolean(host.querySelector('svg, canvas')))"""
    )
    assert all(shown)
    assert page.locator(".map svg").count() == page.locator(".map[data-level=recipe]").count() == 18
    assert page.locator("#top canvas").count() == 1
    assert page.locator("#strips svg").count() > 0
    page.evaluate("dispatchEvent(new Event('afterprint'))")
    assert page.locator(".map:visible").count() == 12


def test_the_keyboard_reaches_everything(browser):
    page = browser.page
    browser.meet()
    page.focus("#play")
    page.keyboard.press("Enter")
    browser.until("document.querySelector('#play').getAttribute('aria-label') === 'Pause'")
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    before = float(page.input_value("#scrub"))
    page.keyboard.press("ArrowRight")
    assert float(page.input_value("#scrub")) == pytest.approx(before + 0.01)
    page.focus("#recipes th button")
    page.keyboard.press("Space")
    assert page.locator("#recipes th").first.get_attribute("aria-sort") == "ascending"
    page.locator(".map:visible summary").first.press("Enter")
    page.locator(".map:visible table").first.wait_for()
    page.focus("#play")
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") != "none"


def test_numbers_under_a_heat_map_are_those_of_the_tooltip(browser):
    page = browser.page
    card = page.locator(".map:visible").first
    card.locator("summary").press("Enter")  # a click may miss: maps are drawn as they come into view, and move it
    first = card.locator("tbody tr").first.inner_text()
    card.scroll_into_view_if_needed()
    card.locator("svg").wait_for()
    cell = card.locator(".mark-rect path").first
    cell.scroll_into_view_if_needed()
    cell.hover(force=True)
    page.wait_for_selector("#tip:not([hidden])")
    text = page.inner_text("#tip")
    assert "safe starts collide" in text
    starts, collisions, rate = first.split("\t")[2:5]
    assert f"{collisions} of {starts} safe starts collide: {rate}" in text


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_the_width_in_light_and_in_dark(browser, width, scheme, tmp_path):
    page = browser.page
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": width, "height": 900})
    page.reload()
    browser.meet()
    assert page.evaluate("document.documentElement.scrollWidth") == width
    paper = page.evaluate("getComputedStyle(document.body).backgroundColor")
    bright = sum(int(part) for part in paper[4:-1].split(",")) > 3 * 128
    assert bright == (scheme == "light")
    picture = tmp_path / f"{width}_{scheme}.png"
    page.screenshot(path=picture, full_page=True)
    assert picture.stat().st_size > 50_000


def test_a_watched_page_loads_itself_again_and_keeps_its_filters(context, small, tmp_path: Path):
    path = tmp_path / "report.html"
    sweep = load(small)
    write_page(sweep, path, 1.0)
    opened = Browser(context, path.as_uri() + "#game=drone")
    write_page(sweep._replace(name="renewed"), path, 1.0)
    playwright.expect(opened.page).to_have_title(re.compile("^renewed"), timeout=60_000)
    # the title comes before the script that reads the address
    playwright.expect(opened.page.locator("#filters select[name=game]")).to_have_value("drone", timeout=60_000)
    assert opened.said == []
    opened.page.close()
