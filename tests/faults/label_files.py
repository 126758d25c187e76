"""Label files with chosen content, as somebody else may have written them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors.torch
from torch import Tensor

from hno.data.store import FORMAT, KEY, _digest
from hno.types import Extremal


def write(path: Path, labels: Extremal, provenance: Mapping[str, Any], **columns: Tensor) -> None:
    """A file whose checksum is right, whatever its columns are."""
    tensors = {**labels._asdict(), **columns}
    header = {"format": FORMAT, "sha256": _digest(tensors), "provenance": dict(provenance)}
    safetensors.torch.save_file(tensors, path, metadata={KEY: json.dumps(header)})


def raw(path: Path, header: bytes, content: bytes = b"", length: int | None = None) -> None:
    """A safetensors file of these bytes, whose header says that it has a length."""
    path.write_bytes((len(header) if length is None else length).to_bytes(8, "little") + header + content)
