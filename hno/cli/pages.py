"""The page about a run or a sweep: what every command leaves behind, and `hno report`."""

from __future__ import annotations

import shlex
import sys
import time
from pathlib import Path

from hno.cli.arguments import Arguments
from hno.cli.config import configured
from hno.cli.schema import ReportSettings

PAGE = "report.html"


def write(folder: Path) -> str:
    """Write the page of a run or of a sweep into its folder.

    Returns:
        A line that says where it lies, or why it could not be written: that costs no run its results.
    """
    again = f"hno report {shlex.quote(str(folder))}"
    try:
        from hno.report.page import write_page
        from hno.report.runs import load

        write_page(load(folder), folder / PAGE)
    except ModuleNotFoundError as error:
        return f"Page: {_needs(error)}, then {again}"
    except Exception as error:
        return f"Page: could not be written ({type(error).__name__}: {error}). Later: {again}"
    return f"Page: {folder / PAGE}"


def _needs(error: ModuleNotFoundError) -> str:
    return f"needs the package {error.name}: pip install altair jinja2 pillow vl-convert-python"


def run(given: Arguments) -> int:
    """`hno report`."""
    try:
        settings = configured("report", ReportSettings, given)
        if settings is not None:
            _report(settings)
    except ModuleNotFoundError as error:
        print(f"A report {_needs(error)}", file=sys.stderr)
        return 1
    except (ValueError, OSError) as error:  # no runs, or settings that make no sense
        print(error, file=sys.stderr)
        return 1
    return 0


def _report(settings: ReportSettings) -> None:
    from hno.report.runs import load

    folder = Path(settings.folder)
    if settings.figures:
        from hno.report.pictures import write_figures

        for path in write_figures(load(folder), Path(settings.to or folder / "figures")):
            print(path)
        return
    from hno.report.page import write_page

    page = Path(settings.to or folder / PAGE)
    page = page / PAGE if page.is_dir() else page
    try:
        while settings.watch is not None:
            write_page(load(folder), page, settings.watch)
            print(f"{page} is up to date; the next look comes in {settings.watch:g} s (Ctrl-C ends).", flush=True)
            time.sleep(settings.watch)
    except KeyboardInterrupt:
        pass  # the last page does not load itself again
    write_page(load(folder), page)
    print(page)
