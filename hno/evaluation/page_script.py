"""A file that hands numbers to a page: pages from disk can load scripts, but no JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

LANDSCAPE = "landscape{}.js"
"""Name of the file beside a run's results; models of an evaluation beyond the first have a number in it."""
CALL, END = "hnoLandscape(", ");\n"


def script(content: Mapping[str, Any], call: str = CALL) -> str:
    """A file that hands content over: one call, of a landscape's function unless another one is named."""
    return f"{call}{json.dumps(content, separators=(',', ':'), allow_nan=False)}{END}"


def check_script(path: Path) -> None:
    """Refuse a file that is more than one call with JSON: a page that loaded it would run what else it says.

    Raises:
        ValueError: it is, or it cannot be read.
    """
    try:
        text = path.read_bytes().decode("ascii")  # which bytes are text must not depend on who reads them
        if not (text.startswith(CALL) and text.endswith(END)):
            raise ValueError("another script")
        json.loads(text.removeprefix(CALL).removesuffix(END))
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path.name} is not hno's: it may hold numbers alone, or a page would run it") from error
