"""The page about a run or a sweep: what every command leaves behind, and `hno report`."""

from __future__ import annotations

import functools
import shlex
import time
from pathlib import Path

from hno.cli.arguments import Arguments, UsageError
from hno.cli.config import configured, read
from hno.cli.settings import ReportSettings
from hno.processes import Interrupted

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
    settings = configured("report", functools.partial(read, ReportSettings), given)
    from hno.report.runs import NoRunsError

    try:
        if settings is not None:
            _report(settings, Path(settings.folder))
    except NoRunsError as error:
        raise UsageError(str(error)) from error
    except ModuleNotFoundError as error:
        raise OSError(f"A report {_needs(error)}") from error
    return 0


def _report(settings: ReportSettings, folder: Path) -> None:
    from hno.report.runs import load

    if settings.figures:
        from hno.report.pictures import write_figures

        print(*write_figures(load(folder), Path(settings.to or folder / "figures")), sep="\n")
        return
    from hno.report.page import write_page

    page = Path(settings.to or folder / PAGE)
    page = page / PAGE if page.is_dir() else page
    try:
        while settings.watch is not None:
            write_page(load(folder), page, settings.watch)
            print(f"{page} is up to date; the next look comes in {settings.watch:g} s (Ctrl-C ends).", flush=True)
            time.sleep(settings.watch)
    except (Interrupted, KeyboardInterrupt):
        pass  # the last page does not load itself again
    write_page(load(folder), page)
    print(page)
