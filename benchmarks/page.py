"""How a page opens, plays and can be used: `python benchmarks/page.py REPORT.html [AXE.js]`.

In Debian's Chromium, headless, without a graphics card: the size; the time from asking for the file to the first picture
and to the end of the last task of more than 50 ms, median and best of five; frames per second while an episode plays, for
one policy and for two over each other, with the longest frame. With the script of axe-core (`npm install axe-core`,
node_modules/axe-core/axe.min.js): what it finds in light and dark, 1280 and 390 pixels wide, with everything unfolded.
"""

from __future__ import annotations

import shutil
import statistics
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page, sync_playwright

REPEATS = 5
WIDTHS = 1280, 390
OPENED = """() => new Promise((resolve) => {
    const tasks = [];
    new PerformanceObserver((list) => tasks.push(...list.getEntries())).observe({ type: "longtask", buffered: true });
    const paint = performance.getEntriesByName("first-contentful-paint")[0]?.startTime ?? NaN;
    setTimeout(() => resolve([paint, Math.max(paint, ...tasks.map((one) => one.startTime + one.duration))]), 1500);
})"""
FRAMES = """(seconds) => new Promise((resolve) => {
    document.querySelector("#scrub").value = 0;
    document.querySelector("#scrub").dispatchEvent(new Event("input"));
    document.querySelector("#speed").value = "0.25";
    document.querySelector("#play").click();
    const times = [];
    requestAnimationFrame(function tick(now) {
        times.push(now);
        if (now - times[0] < 1000 * seconds) return requestAnimationFrame(tick);
        document.querySelector("#play").click();
        resolve(times);
    });
})"""


def opening(browser: Browser, address: str) -> None:
    found = []
    for _ in range(REPEATS):
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(address)
        found.append(page.evaluate(OPENED))
        page.close()
    for name, times in zip(("first picture", "at rest"), zip(*found, strict=True), strict=True):
        print(f"{name}: {statistics.median(times) / 1000:.2f} s, best {min(times) / 1000:.2f} s")


def frames(page: Page, name: str) -> None:
    page.locator("#player").scroll_into_view_if_needed()
    time.sleep(1.0)
    times = page.evaluate(FRAMES, 3.0)
    steps = [after - before for before, after in zip(times, times[1:], strict=False)]
    views = page.locator(".view:visible").count()
    print(f"{name}, {views} view(s): {len(steps) / sum(steps) * 1000:.0f} frames/s, longest {max(steps):.0f} ms")


def playing(browser: Browser, address: str) -> None:
    """One policy, then two from the same start, where the page has such."""
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.goto(address)
    titles = page.locator("#episode option").all_inner_texts()
    for game in dict.fromkeys(page.locator("#filters select[name=game] option").all_inner_texts()):
        if game != "all" and page.locator("#filters").is_visible():
            page.select_option("#filters select[name=game]", game)
        elif game == "all" and page.locator("#filters").is_visible():
            continue
        frames(page, f"playing {game}")
        others = page.locator("#beside option").all_inner_texts()[1:]
        if others:
            page.select_option("#beside", label=others[0])
            frames(page, f"playing {game}, two policies")
    assert titles, "the page has no episodes"
    page.close()


def accessibility(browser: Browser, address: str, axe: str) -> None:
    for scheme in ("light", "dark"):
        for width in WIDTHS:
            page = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
            page.goto(address)
            settle(page)
            page.evaluate(axe)
            found: dict[str, Any] = page.evaluate("axe.run({ resultTypes: ['violations', 'incomplete'] })")
            counts = Counter(one["impact"] for one in found["violations"])
            print(f"axe {found['testEngine']['version']}, {scheme}, {width}: {dict(counts) or 'no finding'}")
            for one in found["violations"]:
                print(f"  {one['impact']} {one['id']}: {one['help']}, {len(one['nodes'])} places")
                for node in one["nodes"][:3]:
                    print(f"    {node['target']} {node['html'][:150]}")
            page.close()


def settle(page: Page) -> None:
    """Unfold everything and draw what is below the fold."""
    page.evaluate("document.querySelectorAll('details').forEach((one) => (one.open = true))")
    for host in page.locator("[data-chart]:visible, #landscape, #player").all():
        host.scroll_into_view_if_needed()
    page.evaluate("scrollTo(0, 0)")
    time.sleep(1.0)


if __name__ == "__main__":
    path = Path(sys.argv[1])
    print(f"size: {path.stat().st_size / 1e6:.2f} MB")
    with sync_playwright() as started:
        opened = started.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        opening(opened, path.resolve().as_uri())
        playing(opened, path.resolve().as_uri())
        if len(sys.argv) > 2:
            accessibility(opened, path.resolve().as_uri(), Path(sys.argv[2]).read_text())
