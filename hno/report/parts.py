"""What a page shows of single runs when somebody looks at them: heat maps and episodes, in scripts beside it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from urllib.parse import quote

from hno.data.store import replace_whole
from hno.evaluation.page_script import script
from hno.report import page_data
from hno.report.recipes import by_type
from hno.report.records import Run
from hno.report.tables import Row

CALL = "hnoPart("
"""What the script of a part begins with."""
EPISODES = 3000
"""Episodes that a page lists, at most."""
Keep = Callable[[Row], Row | str]
"""What becomes of a part in the page: itself, or the address of its script."""


class Beside:
    """Scripts in a folder beside a page, named by their content.

    Args:
        page: where the page will lie.
    """

    def __init__(self, page: Path) -> None:
        self.folder, self.kept = page.with_name(f"{page.stem}_files"), set[str]()

    def keep(self, part: Row) -> str:
        """Write the script of a part; returns its address relative to the page."""
        text = script(part, CALL)
        name = f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.js"
        self.kept.add(name)
        self.folder.mkdir(parents=True, exist_ok=True)
        replace_whole(self.folder / name, lambda draft: draft.write_text(text, encoding="utf-8"))
        return f"{quote(self.folder.name)}/{name}"

    def tidy(self) -> None:
        """Delete scripts that the page before this one had."""
        for path in self.folder.glob(f"{'[0-9a-f]' * 16}.js"):
            if path.name not in self.kept:
                path.unlink(missing_ok=True)


def parts(runs: Sequence[Run], keep: Keep) -> tuple[list[Row], list[Row | str | None], int]:
    """What the page lists, and what it shows of every run.

    Returns:
        An entry for every listed episode, with its run `of` and its place there; for every run its part, as it is kept,
        or None if it has none; and how many episodes there are.
    """
    ranked = page_data.ranked(runs)
    listed, played = list[Row](), [list[Row]() for _ in runs]
    for k, one in ranked[:EPISODES]:
        listed.append({"of": k, "place": len(played[k]), **page_data.entry(one)})
        played[k].append(page_data.playable(runs[k], one))
    found = [
        keep({"map": page_data.heat_map(by_type(run.table)), "episodes": own}) if run.table or own else None
        for run, own in zip(runs, played, strict=True)
    ]
    return listed, found, len(ranked)
