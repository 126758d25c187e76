"""`python -m hno.report <folder>`: a page about a run or a sweep, or its figures."""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path

from hno.report.runs import NoRunsError, load

EVERY = 10.0
"""Seconds between refreshes unless others are asked for."""


def main(arguments: list[str] | None = None) -> int:
    """Entry point.

    Returns:
        0, or 1 where there is nothing to report or nothing to report with; it has been said why.
    """
    chosen = _parser().parse_args(arguments)
    try:
        return _report(chosen)
    except ModuleNotFoundError as error:
        print(
            f"Reports need the package {error.name}: pip install -e '.[report]' in a checkout of hno.", file=sys.stderr
        )
    except (NoRunsError, OSError) as error:
        print(error, file=sys.stderr)
    return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m hno.report", description=__doc__)
    parser.add_argument("folder", type=Path, help="of a run or of a sweep")
    parser.add_argument("--out", type=Path, help="the page; report.html in the folder by default")
    parser.add_argument(
        "--watch", type=_seconds, nargs="?", const=EVERY, metavar="SECONDS",
        help=f"write the page again every so many seconds ({EVERY:g}) until interrupted; an open page follows",
    )  # fmt: skip
    parser.add_argument("--figures", type=Path, metavar="FOLDER", help="write figures and tables for documents instead")
    return parser


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 1 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a number of seconds of at least 1; got {text!r}")
    return value


def _report(chosen: argparse.Namespace) -> int:
    from hno.report.page import write_page

    if chosen.figures is not None:
        from hno.report.figures import write_figures

        for path in write_figures(load(chosen.folder), chosen.figures):
            print(path)
        return 0
    page = chosen.folder / "report.html" if chosen.out is None else chosen.out
    try:
        while chosen.watch is not None:
            write_page(load(chosen.folder), page, chosen.watch)
            print(f"{page} is up to date; the next look comes in {chosen.watch:g} s (Ctrl-C ends).", flush=True)
            time.sleep(chosen.watch)
    except KeyboardInterrupt:
        pass  # the last page does not load itself again
    write_page(load(chosen.folder), page)
    print(page)
    return 0


if __name__ == "__main__":
    sys.exit(main())
