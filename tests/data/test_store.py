from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
import safetensors
import safetensors.torch
import torch

from hno.data import store
from hno.data.store import LabelFileError, canonical_json, checksum, read_labels, start_count, write_labels
from hno.games import make
from hno.types import Extremal, join
from tests.fakes import fake_labels

PROVENANCE = {"game": "NarrowRoad", "request": {"theta": [1.0, 1.0], "count": 4}}


@pytest.fixture
def labels() -> Extremal:
    found = fake_labels(make("narrow_road"))
    found.alternatives[0, 1] = torch.nan
    return found


@pytest.fixture
def written(tmp_path: Path, labels: Extremal) -> Path:
    path = tmp_path / "some" / "folder" / "labels.safetensors"
    write_labels(path, labels, PROVENANCE)
    return path


def bits(labels: Extremal) -> dict[str, tuple[str, tuple[int, ...], bytes]]:
    return {name: (str(t.dtype), tuple(t.shape), t.numpy().tobytes()) for name, t in labels._asdict().items()}


def test_round_trip_is_bit_exact(written: Path, labels: Extremal) -> None:
    read, provenance = read_labels(written)
    assert bits(read) == bits(labels)
    assert provenance == PROVENANCE


def test_starts_are_counted_and_not_rows(tmp_path: Path, labels: Extremal) -> None:
    path, several = tmp_path / "labels.safetensors", labels._replace(start=torch.tensor([0, 0, 1, 1]))
    write_labels(path, several, PROVENANCE)
    assert start_count(path) == read_labels(path)[0].starts == 2
    assert bits(read_labels(path)[0]) == bits(several)


def without(labels: Extremal, path: Path, *columns: str) -> None:
    """A file as it was written before labels had those columns, by means of its own."""
    tensors = {name: tensor for name, tensor in sorted(labels._asdict().items()) if name not in columns}
    digest = hashlib.sha256()
    for name, tensor in tensors.items():
        digest.update(f"{name}:{tensor.dtype}:{tuple(tensor.shape)};".encode() + tensor.numpy().tobytes())
    header = {"format": 2, "provenance": PROVENANCE, "sha256": digest.hexdigest()}
    text = json.dumps(header, sort_keys=True, separators=(",", ":"))
    safetensors.torch.save_file(tensors, path, metadata={"hno": text})


def test_files_that_are_older_than_potentials_are_read(tmp_path: Path, labels: Extremal) -> None:
    """Each of their rows belongs to a start of its own, and its potential is not known."""
    path = tmp_path / "old.safetensors"
    without(labels, path, "potential", "start")
    read, provenance = read_labels(path)
    assert (start_count(path), read.starts, provenance) == (4, 4, PROVENANCE)
    known = labels._replace(potential=torch.full_like(labels.potential, torch.nan), start=torch.arange(4))
    assert bits(read) == bits(known)
    assert join([read, labels]).start.tolist() == list(range(8))


def test_a_file_that_lacks_any_other_column_is_refused(tmp_path: Path, labels: Extremal) -> None:
    path = tmp_path / "old.safetensors"
    without(labels, path, "value")
    with pytest.raises(LabelFileError, match=r"old\.safetensors"):
        read_labels(path)


def test_only_the_label_file_is_left(written: Path) -> None:
    assert list(written.parent.iterdir()) == [written]


def test_metadata_is_one_canonical_json_key(written: Path) -> None:
    with safetensors.safe_open(written, framework="pt") as file:
        metadata = file.metadata()
    assert list(metadata) == ["hno"]
    assert metadata["hno"] == canonical_json(json.loads(metadata["hno"]))


def test_canonical_json_ignores_the_order_of_keys_and_refuses_nan() -> None:
    assert canonical_json({"b": 1, "a": [2, {"d": 3, "c": 4}]}) == canonical_json({"a": [2, {"c": 4, "d": 3}], "b": 1})
    with pytest.raises(ValueError, match="JSON"):
        canonical_json({"a": float("nan")})


def refused(path: Path) -> str:
    """The message with which a file is refused; the file stays as it is."""
    before = path.read_bytes()
    with pytest.raises(LabelFileError) as error:
        read_labels(path)
    assert path.read_bytes() == before
    message = str(error.value)
    assert str(path) in message
    assert "Move it away and run again" in message
    return message


@pytest.mark.parametrize("kept", [0, 4, 100, 0.5, 0.999])
def test_truncated_file_is_refused(written: Path, kept: float) -> None:
    content = written.read_bytes()
    written.write_bytes(content[: int(kept * len(content)) if kept < 1 else int(kept)])
    refused(written)


def test_a_flipped_bit_anywhere_in_the_tensors_is_refused(written: Path) -> None:
    content = written.read_bytes()
    header = 8 + int.from_bytes(content[:8], "little")
    for place in range(header, len(content), (len(content) - header) // 40):
        flipped = bytearray(content)
        flipped[place] ^= 1
        written.write_bytes(flipped)
        assert "checksum" in refused(written)


def test_a_flipped_bit_in_the_header_never_changes_a_label(written: Path, labels: Extremal) -> None:
    content = written.read_bytes()
    for place in range(0, 8 + int.from_bytes(content[:8], "little"), 7):
        flipped = bytearray(content)
        flipped[place] ^= 4
        written.write_bytes(flipped)
        try:
            assert bits(read_labels(written)[0]) == bits(labels)
        except LabelFileError:
            continue


def test_foreign_safetensors_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    safetensors.torch.save_file({"weight": torch.zeros(3)}, path)
    assert "without hno's metadata" in refused(path)
    safetensors.torch.save_file({"weight": torch.zeros(3)}, path, metadata={"hno": "[1, 2"})
    assert "without hno's metadata" in refused(path)


def test_a_foreign_file_has_no_checksum(tmp_path: Path) -> None:
    path = tmp_path / "foreign.safetensors"
    safetensors.torch.save_file({"status": torch.zeros(2)}, path)
    with pytest.raises(LabelFileError, match=r"foreign.*carries no checksum"):
        checksum(path)


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "labels.safetensors"
    path.write_text("these are no labels")
    refused(path)


def test_other_format_is_refused(written: Path, labels: Extremal, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(store, "FORMAT", 99)
        write_labels(written, labels, PROVENANCE)
    assert f"format 99, expected {store.FORMAT}" in refused(written)


def half_a_file(tensors: object, path: str, metadata: object = None) -> None:
    Path(path).write_bytes(b"half a file")
    raise OSError(28, "No space left on device")


def no_rename(source: object, target: object) -> None:
    raise OSError(30, "Read-only file system")


def interrupted(tensors: object, path: str, metadata: object = None) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("target", "name", "failure"),
    [
        (safetensors.torch, "save_file", half_a_file),
        (os, "replace", no_rename),
        (safetensors.torch, "save_file", interrupted),
    ],
    ids=["disk full", "no rename", "interrupted"],
)
def test_existing_file_survives_a_failed_write(
    written: Path, monkeypatch: pytest.MonkeyPatch, target: object, name: str, failure: Callable[..., None]
) -> None:
    before = written.read_bytes()
    monkeypatch.setattr(target, name, failure)
    with pytest.raises((OSError, KeyboardInterrupt)):
        write_labels(written, fake_labels(make("narrow_road"), seed=1), PROVENANCE)
    assert written.read_bytes() == before
    assert list(written.parent.iterdir()) == [written]
