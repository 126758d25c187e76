"""Losses and errors as a CSV file that a killed run can go on with."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, final

from lightning.pytorch.loggers import Logger

from hno.data.store import replace_whole


@final
class CurveLogger(Logger):
    """One row for each call, on disk at once; Lightning's own deletes the file that it finds and keeps rows in memory.

    Args:
        path: the file; what it says of steps before the first one stays.
        first: the step with which the run begins or goes on.
    """

    name, version = "csv", ""

    def __init__(self, path: Path, first: int = 0) -> None:
        super().__init__()
        self.path = path
        kept = [row for row in read_rows(path) if int(row["step"]) < first]
        self.columns = [name for name in kept[0] if any(row[name] for row in kept)] if kept else []
        path.unlink(missing_ok=True) if not kept else self._rewrite(kept)

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Add a row; the file is written anew where it needs more columns."""
        row = {**metrics, "step": step}
        if new := row.keys() - set(self.columns):
            self.columns = sorted([*self.columns, *new])
            self._rewrite([*read_rows(self.path), row])
            return
        whole = self.path.stat().st_size
        try:
            with self.path.open("a", newline="") as file:
                self._writer(file).writerow(row)
        except OSError:  # a full disk: no half row stays
            os.truncate(self.path, whole)
            self._rewrite([*read_rows(self.path), row])  # this does not fit either, and says what to do

    def log_hyperparams(self, *params: Any, **named: Any) -> None:
        """They are in results.json."""

    def _rewrite(self, rows: Iterable[Mapping[str, Any]]) -> None:
        def write(draft: Path) -> None:
            with draft.open("w", newline="") as file:
                writer = self._writer(file)
                writer.writeheader()
                writer.writerows(rows)

        self.path.parent.mkdir(parents=True, exist_ok=True)
        replace_whole(self.path, write)

    def _writer(self, file: Any) -> csv.DictWriter[str]:
        return csv.DictWriter(file, self.columns, extrasaction="ignore", lineterminator="\n")


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of the file, without one at its end that a killed process left half written."""
    if not path.exists():
        return []
    whole = path.read_text().rpartition("\n")[0]
    return list(csv.DictReader(whole.splitlines()))
