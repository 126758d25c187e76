"""Label files: safetensors with verified content, written whole or not at all."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from hno.data.soundness import flaw
from hno.types import Extremal

FORMAT = 2
"""Version of the file layout."""
ADDED = {"potential", "start"}
"""Columns that older files of this format lack."""
KEY = "hno"
"""The metadata key that holds the canonical JSON."""


class LabelFileError(RuntimeError):
    """A label file that is damaged, foreign or of another format."""


def canonical_json(content: Mapping[str, Any]) -> str:
    """JSON with sorted keys and no spaces, equal for equal content."""
    return json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)


def write_labels(path: Path, labels: Extremal, provenance: Mapping[str, Any]) -> None:
    """Write a label file under a temporary name, then rename it into place.

    Args:
        path: where; an existing file is replaced only by a complete one.
        labels: extremals of one game.
        provenance: how they were made, JSON content.

    Raises:
        LabelFileError: labels that `read_labels` would refuse.
    """
    if reason := flaw(labels):
        raise LabelFileError(f"{path} is not written, since these are no labels: {reason}.")
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in labels._asdict().items()}
    header = {"format": FORMAT, "sha256": _digest(tensors), "starts": labels.starts, "provenance": dict(provenance)}
    text = canonical_json(header)
    replace_whole(path, lambda draft: safetensors.torch.save_file(tensors, draft, metadata={KEY: text}))


def replace_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file under a temporary name and rename it into place, readable by everyone; nothing half-written stays.

    Args:
        path: the file; its folder is made where it is missing.
        write: fills the file at the path that it gets.

    Raises:
        OSError: with the path, where it cannot be written: a full disk, a quota, a read-only folder.
    """
    draft = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        os.close(handle)
        draft = Path(name)
        write(draft)
        draft.chmod(0o644)
        draft.replace(path)
    except (OSError, safetensors.SafetensorError) as error:
        reason = getattr(error, "strerror", None) or error
        raise OSError(
            f"{path} could not be written ({reason}); what was there before is whole. Free some space, or choose "
            "another folder."
        ) from error
    finally:
        if draft is not None:
            draft.unlink(missing_ok=True)


def read_labels(path: Path) -> tuple[Extremal, dict[str, Any]]:
    """Read and verify a label file.

    Returns:
        The extremals and their provenance.

    Raises:
        LabelFileError: not a label file, another format, its content does not match its checksum, or is no sound
            labels (`hno.data.soundness`).
    """
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
    except (safetensors.SafetensorError, OSError) as error:
        raise _unreadable(path, error) from error
    try:
        header = json.loads(metadata[KEY])
        found = header["format"], header["sha256"], dict(header["provenance"])
    except (KeyError, ValueError, TypeError, RecursionError) as error:
        raise LabelFileError(f"{path} is a safetensors file without hno's metadata. {ADVICE}") from error
    if found[0] == FORMAT and (missing := sorted(set(Extremal._fields) ^ (set(tensors) | ADDED))):
        raise LabelFileError(f"{path} has other columns than labels of this version: {', '.join(missing)}. {ADVICE}")
    if found[0] != FORMAT:
        raise LabelFileError(f"{path} has format {found[0]}, expected {FORMAT}. {ADVICE}")
    if found[1] != _digest(tensors):
        raise LabelFileError(f"{path} is damaged: its content does not match its checksum. {ADVICE}")
    try:
        labels = Extremal(**{**_without_potential(tensors), **tensors})
        reason = flaw(labels)
    except (IndexError, RuntimeError, TypeError) as error:
        reason = f"columns that do not fit each other ({error})"
    if reason is None and header.get("starts", labels.starts) != labels.starts:
        reason = f"{labels.starts} start states, its header says {header['starts']}"
    if reason is not None:
        raise LabelFileError(f"{path} holds no sound labels: {reason}. {ADVICE}")
    return labels, found[2]


def _without_potential(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """What files lack that are older than potentials: theirs are unknown, and every row has a start of its own."""
    return {
        "potential": torch.full_like(tensors["value"][..., 0], torch.nan),
        "start": torch.arange(len(tensors["status"])),
    }


def start_count(path: Path) -> int:
    """How many start states a label file has, by its header.

    Raises:
        LabelFileError: not a label file.
    """
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {}).get(KEY, "{}"))
            return int(header.get("starts", file.get_slice("status").get_shape()[0]))
    except _UNREADABLE as error:
        raise _unreadable(path, error) from error


def checksum(path: Path) -> str:
    """The checksum of its content that a label file carries.

    Raises:
        LabelFileError: not a label file.
    """
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            return str(json.loads((file.metadata() or {})[KEY])["sha256"])
    except _UNREADABLE as error:
        raise LabelFileError(f"{path} carries no checksum of hno's ({error!r}). {ADVICE}") from error


_UNREADABLE = (
    safetensors.SafetensorError, ArithmeticError, AttributeError, LookupError, OSError, RecursionError, TypeError,
    ValueError,
)  # fmt: skip
"""What reading the header of a damaged or foreign file raises."""
ADVICE = "Move it away and run again; the labels are then solved anew."
"""What to do about a damaged file."""


def _unreadable(path: Path, error: Exception) -> Exception:
    """What a file that cannot be opened means; the fault of a disk that cannot map files into memory is no damage."""
    if getattr(error, "errno", None) == errno.ENODEV or "os error 19" in str(error):
        return OSError(f"{path}: its disk cannot map files into memory. Choose another folder with $HNO_CACHE.")
    if isinstance(error, PermissionError):
        return OSError(f"{path} may not be read ({error}). Choose another folder with $HNO_CACHE.")
    return LabelFileError(f"{path} cannot be read as a label file ({error}). {ADVICE}")


def _digest(tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name}:{tensor.dtype}:{tuple(tensor.shape)};".encode())
        digest.update(tensor.contiguous().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()
