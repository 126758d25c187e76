"""What a terminal shows: tables that fit, named bars, and one line where a signal ends the work."""

from __future__ import annotations

import io
import logging
import os
import pty
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from hno.cli import progress as module
from hno.cli.logs import loggers
from hno.cli.progress import Terse, label_progress, progress
from hno.cli.tables import GAP, parts, print_table
from hno.data.labels import Progress
from hno.evaluation.sections import sections
from hno.processes import Interrupted
from tests.cli.conftest import SMOKE, Command
from tests.cli.test_configs import settings

ROOT = Path(__file__).parents[2]


def table(width: int, titles: list[str], rows: list[list[str]]) -> list[str]:
    """Lines of a table on a terminal of a width."""
    printed = io.StringIO()
    print_table(Console(file=printed, width=width), titles, rows, "a title", "a note")
    return printed.getvalue().splitlines()


@pytest.mark.parametrize("width", [80, 138, 200])
def test_nothing_in_a_table_is_cut_and_no_line_is_too_long(width: int) -> None:
    columns = [column.title for column in sections.get("table")().columns]
    cells = ["1.5, 2.5", "unseen", "128 of 128", "128", "100.00 %", "34.91 to 96.81 %", "0.45, 2.75"]
    cells += ["12,345.67 of 18.55", "100.0 %", "100.0 %", "139.1 %, 106.3 %", "10 / 11 / 12"]
    assert len(columns) == len(cells)
    lines = table(width, columns, [cells, cells])
    assert max(map(len, lines)) <= width
    assert all(sum(cell in line for line in lines) >= 2 for cell in cells)
    words = {word for line in lines for word in line.split()}
    assert {word for title in columns for word in title.split()} <= words
    assert (width < 200) == (sum(line.startswith("theta") for line in lines) > 1)


def test_a_long_word_is_not_parted() -> None:
    """Text takes several lines; a path among it stays one that can be copied."""
    path = "multirun/2026-11-28/12-00-00/0_narrow_road_sno_sin/best.ckpt"
    lines = table(80, ["run", "reason"], [["0", f"the file at this place cannot be read: {path}"]])
    assert any(path in line for line in lines)


def test_every_column_stands_in_one_part_behind_the_first() -> None:
    draw = random.Random(0)
    for _ in range(50):
        widths = [draw.randint(1, 40) for _ in range(draw.randint(1, 15))]
        found = list(parts(widths, 80))
        assert [column for part in found for column in part[1:]] == list(range(1, len(widths)))
        assert all(part[0] == 0 for part in found)
        wide = [part for part in found if sum(widths[at] + GAP for at in part) - GAP > 80]
        assert all(len(part) == 2 for part in wide), "only a column that fits nowhere is too wide"


def test_long_texts_fold_at_words() -> None:
    lines = table(40, ["job", "settings"], [["0", "optimizer.lr=0.001 sampler=mixed network.width=128"]])
    assert max(map(len, lines)) <= 40
    assert all(any(word in line for line in lines) for word in ("optimizer.lr=0.001", "network.width=128"))


def test_work_under_way_has_a_name_and_the_time_left(caplog: pytest.LogCaptureFixture, monkeypatch: Any) -> None:
    monkeypatch.setattr(module, "EVERY", 0.0)
    with caplog.at_level(logging.INFO), label_progress("test labels") as report:
        for done in (0, 5, 10):
            report(Progress(done, 10, done))
    said = [record.getMessage() for record in caplog.records]
    assert said[0] == "test labels: 0 of 10"
    assert said[1] == "test labels: 5 of 10: 5 converged, 0 failed, 0 s left"
    assert said[2] == "test labels: 10 of 10: 10 converged, 0 failed"


def test_a_signal_says_in_which_work_it_came() -> None:
    def work() -> None:
        with progress("training", None) as update:
            update(96, 5000)
            raise Interrupted(2)

    with pytest.raises(Interrupted) as caught:
        work()
    assert caught.value.__notes__ == ["In training, 96 of 5000 done"]


def test_bars_go_where_work_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)

    def work() -> None:
        with progress("outer"), progress("inner") as update:
            update(1, 2)
            assert [task.description for task in module._bars.tasks] == ["outer", "inner"]
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        work()
    assert not module._bars.tasks
    assert not module._bars.live.is_started


def test_what_a_bar_says_is_in_the_file_alone(capsys: pytest.CaptureFixture[str]) -> None:
    logger = logging.Logger("any")
    logger.addHandler(Terse())
    logger.info("step 200 of 2000", extra=module.FILE_ONLY)
    logger.warning("it is late")
    printed = capsys.readouterr().out
    assert "step" not in printed
    assert printed.endswith(" Warning: it is late\n")


def test_the_first_line_names_the_folder_and_the_log_has_steps(command: Command) -> None:
    run = command("train", *SMOKE, "trainer.max_steps=2", "trainer.print_every=1", "tags=[try]", "notes=why")
    assert run.text.splitlines()[0] == f"Run: {run.folder}"
    assert "step 2 of 2: loss/" in (run.folder / "train.log").read_text()
    assert (run.results["config"]["tags"], run.results["config"]["notes"]) == (["try"], "why")


@pytest.mark.parametrize(
    ("environment", "line"),
    [({"WANDB_MODE": "disabled"}, "W&B is switched off"), ({}, "W&B is not installed")],
)
def test_without_wandb_metrics_are_csv_and_one_line_says_so(
    environment: dict[str, str],
    line: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.delenv("WANDB_MODE", raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    if not environment:
        monkeypatch.setattr("hno.cli.logs.importlib.util.find_spec", lambda name: None)
    with caplog.at_level(logging.INFO):
        made = loggers(settings("logger.names=[wandb]"), tmp_path)
    assert [logger.name for logger in made] == ["csv"]
    assert [record.getMessage().partition(":")[0] for record in caplog.records] == [line]


HELP = """
import sys
import hno
from hno.cli.main import COMMANDS, main
for words in ([], *([name] for name in COMMANDS)):
    assert main([*words, "--help"]) == 0
heavy = {"torch", "lightning", "wandb", "scipy", "pandas", "joblib"} & set(sys.modules)
assert not heavy, heavy
"""


def test_help_of_every_command_imports_nothing_heavy() -> None:
    done = subprocess.run([sys.executable, "-c", HELP], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_terminal_of_80_columns_shows_a_run_without_other_libraries_lines(tmp_path: Path) -> None:
    main, other = pty.openpty()
    words = ["debug=fast", "logger=wandb", "evaluation.dt=0.1", f"hydra.run.dir={tmp_path / 'run'}"]
    environment = os.environ | {"COLUMNS": "80", "TERM": "dumb", "HOME": str(tmp_path), "PYTHONPATH": str(ROOT)}
    environment.pop("WANDB_MODE", None)
    process = subprocess.Popen(
        [sys.executable, "train.py", *words], cwd=ROOT, env=environment, stdout=other, stderr=other
    )
    os.close(other)
    shown = b""
    try:
        while chunk := os.read(main, 65536):
            shown += chunk
    except OSError:  # its end
        pass
    assert process.wait() == 0, shown
    text = shown.decode()
    assert text.startswith("Run: ")
    assert sum(line.startswith("wandb:") or "Deprecat" in line for line in text.splitlines()) <= 10
    assert "…" not in text
