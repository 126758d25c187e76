from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from hno.data.certificates import summary
from hno.data.labels import Request, label_set, labels_for, start_states
from hno.data.shards import MANIFEST, SHARD, LabelSet
from hno.data.store import LabelFileError, checksum
from hno.games import make
from hno.types import Extremal, of_starts
from tests.data.conftest import Asked
from tests.fakes import fake_solve

REQUEST = Request((1.0, 5.0), 300, 0, "train")

Fill = Callable[..., LabelSet]


@pytest.fixture
def fill(tmp_path: Path, asked: Asked) -> Fill:
    """Generate a set with a solver that answers at once; without arguments one of three shards."""

    def generated(starts: int = 300, cache: Path = tmp_path / "cache") -> LabelSet:
        request = REQUEST._replace(starts=starts)
        labels_for(make("narrow_road"), [request], cache, workers=1)
        return label_set(make("narrow_road"), request, cache)

    return generated


def files(labels: LabelSet) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in labels.folder.iterdir() if path.name != ".lock"}


def manifest(labels: LabelSet) -> dict[str, object]:
    def refuse(constant: str) -> None:
        raise AssertionError(f"the manifest holds {constant}")

    return json.loads((labels.folder / MANIFEST).read_text(), parse_constant=refuse)


def rows(count: int) -> Extremal:
    """The first rows of the set, as they should be."""
    x0 = start_states(make("narrow_road"), REQUEST._replace(starts=count))
    return fake_solve(make("narrow_road"), x0, torch.tensor([REQUEST.theta]).expand(count, -1))


def bits(labels: Extremal) -> list[bytes]:
    return [tensor.numpy().tobytes() for tensor in labels]


def test_a_set_is_shards_and_a_manifest(fill: Fill) -> None:
    labels = fill()
    assert sorted(files(labels)) == [MANIFEST, *(f"shard-0000{shard}.safetensors" for shard in range(3))]
    assert [labels.starts(shard) for shard in range(4)] == [SHARD, SHARD, 300 - 2 * SHARD, 0]


def test_a_set_is_read_in_the_order_of_its_starts(fill: Fill) -> None:
    labels = fill()
    for starts in (1, SHARD, SHARD + 1, 300):
        assert bits(labels.read(starts)) == bits(rows(starts))


def test_more_rows_than_there_are_cannot_be_read(fill: Fill) -> None:
    labels = fill()
    with pytest.raises(LabelFileError, match=r"shard-00002.* holds 44 start states, expected 45"):
        labels.read(301)


def test_an_extended_set_keeps_its_rows_and_solves_only_what_is_missing(fill: Fill, asked: Asked) -> None:
    before = bits(fill(100).read(100))
    assert asked.total() == 100
    labels = fill(300)
    assert asked.total() == 300
    assert bits(labels.read(100)) == before


@pytest.mark.parametrize("grown", [(100, 300), (1, 127, 128, 129, 300), (256, 300), (300, 5)])
def test_an_extended_set_equals_one_made_at_once(fill: Fill, tmp_path: Path, grown: tuple[int, ...]) -> None:
    for starts in grown:
        labels = fill(starts)
    assert files(labels) == files(fill(300, tmp_path / "at once"))


def test_full_shards_are_not_written_again(fill: Fill) -> None:
    labels = fill(150)
    before = labels.path(0).stat()
    fill(300)
    assert labels.path(0).stat() == before


def test_a_partial_shard_in_the_middle_is_completed(fill: Fill, asked: Asked) -> None:
    labels = fill()
    before = files(labels)
    short = of_starts(labels.read_shard(1), 0, 50)
    labels.path(1).unlink()
    labels.append(1, 0, short)
    asked.clear()
    fill()
    assert asked.total() == SHARD - 50
    assert files(labels) == before


def test_a_missing_shard_in_the_middle_is_solved(fill: Fill, asked: Asked) -> None:
    labels = fill()
    before = files(labels)
    labels.path(1).unlink()
    asked.clear()
    fill()
    assert asked.total() == SHARD
    assert files(labels) == before


def test_a_request_before_a_missing_shard_is_answered(fill: Fill, asked: Asked) -> None:
    """Workers finish in any order, so that a killed run may leave a gap."""
    labels = fill()
    labels.path(1).unlink()
    asked.clear()
    fill(100)
    assert asked.total() == 0
    assert [shard["file"] for shard in manifest(labels)["shards"]] == [labels.path(0).name, labels.path(2).name]
    assert manifest(labels)["summary"]["starts"] == 300 - SHARD


def test_rows_that_two_processes_solved_are_kept_once(fill: Fill, tmp_path: Path) -> None:
    labels = fill(20)
    for count in (60, 40, 80):
        labels.append(0, 20, of_starts(rows(count), 20))
    assert bits(labels.read_shard(0)) == bits(rows(80))


def test_rows_are_not_added_behind_a_gap(fill: Fill) -> None:
    labels = fill(20)
    before = files(labels)
    with pytest.raises(LabelFileError, match=r"shard-00000.* shrank from 30 to 20 start states"):
        labels.append(0, 30, of_starts(rows(40), 30))
    assert files(labels) == before


@pytest.mark.parametrize("shard", [0, 1, 2])
@pytest.mark.parametrize("damage", ["flipped", "truncated", "empty"])
def test_a_damaged_shard_is_named_moved_aside_and_solved_again(
    fill: Fill, asked: Asked, shard: int, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    labels = fill()
    before, path = files(labels), labels.path(shard)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes({"flipped": content, "truncated": content[:-100], "empty": b""}[damage])
    damaged = path.read_bytes()
    asked.clear()
    fill()
    assert asked.total() == min(SHARD, 300 - shard * SHARD)
    assert files(labels) == before | {f"{path.name}.damaged": damaged}
    assert f"It is moved to {path.name}.damaged, and its labels are solved again." in caplog.text


def test_a_damaged_shard_that_cannot_be_moved_is_an_error(fill: Fill, monkeypatch: pytest.MonkeyPatch) -> None:
    labels = fill()
    labels.path(1).write_bytes(labels.path(1).read_bytes()[:-100])
    before = files(labels)
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(LabelFileError, match=rf"{labels.path(1)} .*Move it away"):
        fill()
    assert files(labels) == before


def test_a_damaged_shard_that_was_moved_away_is_solved_again(fill: Fill, tmp_path: Path) -> None:
    labels = fill()
    before = files(labels)
    labels.path(1).write_bytes(labels.path(1).read_bytes()[:-5])
    labels.path(1).rename(tmp_path / "damaged")
    fill()
    assert files(labels) == before


def test_a_shard_of_other_settings_is_moved_aside(fill: Fill, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    labels = fill()
    other = REQUEST._replace(seed=1)
    labels_for(make("narrow_road"), [other], tmp_path / "other", workers=1)
    before = files(labels)
    shutil.copy(label_set(make("narrow_road"), other, tmp_path / "other").path(1), labels.path(1))
    foreign = labels.path(1).read_bytes()
    fill()
    assert files(labels) == before | {f"{labels.path(1).name}.damaged": foreign}
    assert "shard-00001.safetensors was made by other settings" in caplog.text


def test_manifest_says_what_is_in_the_shards(fill: Fill) -> None:
    labels = fill()
    content = manifest(labels)
    assert content["provenance"] == json.loads(json.dumps(labels.provenance))
    assert content["summary"] == summary(rows(300))
    assert content["versions"].keys() == {"hno", "torch"}
    assert content["shards"] == [
        {"file": labels.path(shard).name, "rows": labels.starts(shard), "sha256": checksum(labels.path(shard))}
        for shard in range(3)
    ]


@pytest.mark.parametrize("content", [None, "", "{", "[]", '{"shards": []}'])
def test_a_missing_or_stale_manifest_is_written_again(fill: Fill, content: str | None) -> None:
    labels = fill()
    before = files(labels)
    path = labels.folder / MANIFEST
    if content is None:
        path.unlink()
    else:
        path.write_text(content)
    fill()
    assert files(labels) == before


def test_manifest_follows_rows_that_were_added_without_it(fill: Fill) -> None:
    labels = fill(20)
    labels.append(0, 20, of_starts(rows(40), 20))
    labels.write_manifest()
    assert [shard["rows"] for shard in manifest(labels)["shards"]] == [40]
    assert manifest(labels)["summary"] == summary(rows(40))


def test_drafts_of_killed_writers_are_removed(fill: Fill) -> None:
    labels = fill()
    before = files(labels)
    for name in (".shard-00001.safetensors.ab12", f".{MANIFEST}.cd34", ".tmpjbPa4K"):
        (labels.folder / name).write_bytes(b"half a file")
    fill()
    assert files(labels) == before


def test_reading_a_complete_set_writes_nothing(fill: Fill) -> None:
    labels = fill()
    (labels.folder / ".lock").unlink(missing_ok=True)
    before = {path: path.stat() for path in (labels.folder, *labels.folder.iterdir())}
    fill(200)
    after = {path: path.stat() for path in (labels.folder, *labels.folder.iterdir())}
    assert [(path, stat.st_mtime_ns) for path, stat in after.items()] == [
        (path, stat.st_mtime_ns) for path, stat in before.items()
    ]


def test_a_stale_manifest_does_not_keep_a_read_only_set_from_being_read(
    fill: Fill, monkeypatch: pytest.MonkeyPatch
) -> None:
    labels = fill()
    (labels.folder / MANIFEST).write_text("{}")
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert bits(fill(200).read(200)) == bits(rows(200))
    assert (labels.folder / MANIFEST).read_text() == "{}"


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_set_can_be_read(fill: Fill) -> None:
    labels = fill()
    labels.folder.chmod(0o555)
    try:
        assert bits(fill(200).read(200)) == bits(rows(200))
        with pytest.raises(OSError, match=r"\$HNO_CACHE"):
            fill(400)
    finally:
        labels.folder.chmod(0o755)
