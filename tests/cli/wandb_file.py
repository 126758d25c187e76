"""What an offline W&B run would upload, read from its `run-*.wandb`: a LevelDB log of protocol buffers."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from wandb.proto.wandb_internal_pb2 import Record

BLOCK, HEADER = 32768, 7
FULL, LAST = 1, 4


def messages(content: bytes) -> Iterator[bytes]:
    """Messages of a LevelDB log whose own header is as long as that of a chunk."""
    at, message = HEADER, b""
    while at + HEADER <= len(content):
        left = BLOCK - at % BLOCK
        if left < HEADER:
            at += left
            continue
        length, kind = int.from_bytes(content[at + 4 : at + 6], "little"), content[at + 6]
        message += content[at + HEADER : at + HEADER + length]
        at += HEADER + length
        if kind in (FULL, LAST):
            yield message
            message = b""


class OfflineRun(NamedTuple):
    """An offline run."""

    id: str
    name: str
    group: str
    config: dict[str, Any]
    summary: dict[str, Any]
    history: list[dict[str, Any]]
    exit_code: int | None
    job: str
    tags: list[str]
    notes: str
    files: set[str]
    """Of its artifacts."""


def written(path: Path, seconds: float = 20.0) -> list[Record]:
    """Records of a run that was finished; W&B's own process may still be writing them."""
    end = time.monotonic() + seconds
    while True:
        found = [Record.FromString(message) for message in messages(path.read_bytes())]
        if any(record.HasField("exit") for record in found) or time.monotonic() > end:
            return found
        time.sleep(0.05)


def history_of(path: Path) -> list[dict[str, Any]]:
    """Rows that a run logged, as far as they were written."""
    found = [Record.FromString(message) for message in messages(path.read_bytes())]
    return [
        {item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in record.history.item}
        for record in found
        if record.HasField("history")
    ]


def offline_run(folder: Path) -> OfflineRun:
    """The one offline run of a run folder."""
    (path,) = folder.glob("wandb/offline-run-*/run-*.wandb")
    found = written(path)
    (run,) = (record.run for record in found if record.HasField("run"))
    history = history_of(path)
    summary = {key: value for row in history for key, value in row.items()}
    for record in found:
        if record.HasField("summary"):
            summary |= {item.key or item.nested_key[0]: json.loads(item.value_json) for item in record.summary.update}
    codes = [record.exit.exit_code for record in found if record.HasField("exit")]
    return OfflineRun(
        run.run_id,
        run.display_name,
        run.run_group,
        {item.key: json.loads(item.value_json) for item in run.config.update},
        summary,
        history,
        codes[-1] if codes else None,
        run.job_type,
        list(run.tags),
        run.notes,
        {entry.path for record in found if record.HasField("artifact") for entry in record.artifact.manifest.contents},
    )
