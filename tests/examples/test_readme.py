from __future__ import annotations

import re

from tests.examples.conftest import FOLDER

ROWS = re.findall(r"\]\(([\w/.]+)\) \| (\d+) \|", (FOLDER / "README.md").read_text())


def test_every_example_is_listed_with_its_lines_and_none_is_long():
    lines = {path: len((FOLDER / path).read_text().splitlines()) for path, _ in ROWS}
    assert {path: int(count) for path, count in ROWS} == lines
    assert max(lines.values()) <= 80
    files = {str(path.relative_to(FOLDER)) for path in FOLDER.rglob("*.py") if path.name != "__init__.py"}
    assert {file for file in files if not file.startswith("ros2_node/")} <= lines.keys()
