"""The page that a command leaves behind."""

from __future__ import annotations

import shlex
from pathlib import Path

PAGE = "report.html"


def write(folder: Path) -> str:
    """Write the page of a run or of a sweep into its folder.

    Returns:
        A line that says where it lies, or why it could not be written: that costs no run its results.
    """
    again = f"python -m hno.report {shlex.quote(str(folder))}"
    try:
        from hno.report.page import write_page
        from hno.report.runs import load

        write_page(load(folder), folder / PAGE)
    except ModuleNotFoundError as error:
        return f"Page: needs the package {error.name}. With it: {again}"
    except Exception as error:
        return f"Page: could not be written ({type(error).__name__}: {error}). Later: {again}"
    return f"Page: {folder / PAGE}"
