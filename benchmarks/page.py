"""How a page opens, plays and can be used: `python benchmarks/page.py REPORT.html [AXE.js]`.

In Debian's Chromium, headless, without a graphics card, at 1280 by 900: the size; how long it takes to the first
picture and to the end of the last task of more than 50 ms, and what the page's own thread works for that, median and
best of five; then, while an episode plays, for one policy and for two over each other: frames per second, the longest
frame, and work per frame. Other programs on the machine lengthen times, not work. With the script of axe-core (`npm
install axe-core`, node_modules/axe-core/axe.min.js): what it finds in light and dark, 1280 and 390 wide, all unfolded.
"""

from __future__ import annotations

import itertools
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
VIEW: Any = {"width": 1280, "height": 900}
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


class Opened:
    """A page in a tab of its own, and what its thread has worked."""

    def __init__(self, browser: Browser, address: str, **options: Any) -> None:
        self.page: Page = browser.new_page(**options)
        self.devtools = self.page.context.new_cdp_session(self.page)
        self.devtools.send("Performance.enable", {"timeDomain": "threadTicks"})
        self.page.goto(address)

    def work(self) -> float:
        """So far, s."""
        found = self.devtools.send("Performance.getMetrics")["metrics"]
        return next(one["value"] for one in found if one["name"] == "TaskDuration")


def opening(browser: Browser, address: str) -> None:
    """Print how long it takes."""
    found = []
    for _ in range(REPEATS):
        opened = Opened(browser, address, viewport=VIEW)
        times = opened.page.evaluate(OPENED)
        found.append([*(time / 1000 for time in times), opened.work()])
        opened.page.close()
    for name, some in zip(("first picture", "at rest", "work"), zip(*found, strict=True), strict=True):
        print(f"{name}: {statistics.median(some):.2f} s, best {min(some):.2f} s")


def frames(opened: Opened, name: str) -> None:
    """Print how smooth it is."""
    opened.page.locator("#player").scroll_into_view_if_needed()
    time.sleep(1.5)
    before = opened.work()
    times = opened.page.evaluate(FRAMES, 3.0)
    work = 1000 * (opened.work() - before) / len(times)
    steps = [after - before for before, after in itertools.pairwise(times)]
    views = opened.page.locator(".view:visible").count()
    speed = f"{len(steps) / sum(steps) * 1000:.0f} frames/s, longest {max(steps):.0f} ms, work {work:.1f} ms each"
    print(f"{name}, {views} view(s): {speed}")


def playing(browser: Browser, address: str) -> None:
    """One policy of every game, then two from the same start, where the page has such."""
    opened = Opened(browser, address, viewport=VIEW)
    choice = opened.page.locator("#filters select[name=game]")
    for game in choice.locator("option").all_inner_texts()[1:]:
        if choice.is_visible():
            choice.select_option(game)
        frames(opened, f"playing {game}")
        others = opened.page.locator("#beside option").all_inner_texts()[1:]
        if others:
            opened.page.select_option("#beside", label=others[0])
            frames(opened, f"playing {game}, two policies")
    opened.page.close()


def accessibility(browser: Browser, address: str, axe: str) -> None:
    """Print what axe finds."""
    for scheme in ("light", "dark"):
        for width in WIDTHS:
            page = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
            page.goto(address)
            settle(page)
            page.evaluate(axe)
            found: dict[str, Any] = page.evaluate("axe.run({ resultTypes: ['violations', 'incomplete'] })")
            counts = Counter(one["impact"] for one in found["violations"])
            print(
                f"axe {found['testEngine']['version']}, {scheme}, {width}: {dict(counts) or 'no finding'}; "
                f"{len(found['passes'])} rules hold, {len(found['incomplete'])} for people to judge"
            )
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
