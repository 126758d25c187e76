"""MkDocs hook: every notebook is a page. Markdown cells stay; code cells become code blocks, with what they printed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Replace notebooks by pages of the same name."""
    for file in list(files):
        if file.src_uri.endswith(".ipynb") and file.abs_src_path is not None:
            cells = json.loads(Path(file.abs_src_path).read_text(encoding="utf-8"))["cells"]
            page = file.src_uri.removesuffix(".ipynb") + ".md"
            files.append(File.generated(config, page, content="\n\n".join(map(_markdown, cells))))
    return files


def _markdown(cell: dict[str, Any]) -> str:
    source = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        return source
    printed = "".join("".join(output.get("text", [])) for output in cell["outputs"])
    return f"```python\n{source}\n```" + (f"\n\n```text\n{printed.rstrip()}\n```" if printed else "")
