"""The licence of every installed package, as it states it.

python benchmarks/licences.py
"""

from __future__ import annotations

from email.message import Message
from importlib.metadata import distributions


def licence(stated: Message) -> str:
    """An SPDX expression, else the classifiers, else the first line of the text; "unknown" where there is none."""
    kinds = [
        entry.rpartition(" :: ")[2] for entry in stated.get_all("Classifier") or [] if entry.startswith("License ::")
    ]
    text = str(stated.get("License") or "").strip().partition("\n")[0]
    return str(stated.get("License-Expression") or ", ".join(kinds) or text or "unknown")


def main() -> None:
    """Print a line for each package."""
    found = {str(each.metadata["Name"]): each for each in distributions()}
    for name, each in sorted(found.items(), key=lambda entry: entry[0].lower()):
        print(f"{name:32} {each.version:20} {licence(each.metadata)}")  # type: ignore[arg-type]  # it is a Message


if __name__ == "__main__":
    main()
