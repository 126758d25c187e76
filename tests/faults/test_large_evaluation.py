"""An evaluation of very many starts takes the memory of one type of them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from hno.data.labels import Request, label_set, start_states
from hno.data.shards import SHARD
from hno.games import make
from hno.games.grid import parse_types
from hno.pontryagin.solve import Solver
from tests.cli.conftest import save_random
from tests.fakes import fake_labels

TYPES, STARTS = "grid5", 12_960
"""25 types: 324,000 starts in all."""


def made_labels(cache: Path, types: str, starts: int) -> None:
    """Made-up labels in the place of solved ones: 2.6 GB for all types."""
    game = make("narrow_road")
    for theta in parse_types(game, types, key="theta"):
        request = Request(theta, starts, 1000, "test")
        labels = label_set(game, request, cache, Solver())
        for shard, x0 in enumerate(start_states(game, request).split(SHARD)):
            labels.append(shard, 0, fake_labels(game, theta, len(x0), shard, start=x0))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="memory is counted in other units elsewhere")
def test_an_evaluation_of_324_000_starts_stays_below_two_gibibytes(tmp_path: Path) -> None:
    made_labels(tmp_path / "labels", TYPES, STARTS)
    checkpoint = save_random(tmp_path / "random" / "last.ckpt")
    settings = f"checkpoint={checkpoint}", f"theta={TYPES}", f"starts={STARTS}", f"cache={tmp_path / 'labels'}"
    process = subprocess.Popen(
        [sys.executable, "-m", "hno", "evaluate", *settings, "workers=1", f"hydra.run.dir={tmp_path / 'run'}"]
    )
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0
    table = json.loads((tmp_path / "run" / "results.json").read_text())["table"]
    starts = sum(row["starts"] for row in table)
    print(f"1 case: {starts:,} starts of {len(table)} types; at most {usage.ru_maxrss / 2**20:.2f} GiB")
    assert starts == 324_000
    assert usage.ru_maxrss < 2 * 2**20
