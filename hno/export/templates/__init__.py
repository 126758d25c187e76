"""What the generated files have in common; words between @ are filled in."""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib import resources


def filled(name: str, words: Mapping[str, object]) -> str:
    """The text of a template."""
    text = (resources.files(__name__) / name).read_text(encoding="utf-8")
    return re.sub(r"@([A-Z_]+)@", lambda found: str(words[found[1]]), text)
