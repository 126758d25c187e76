"""Checkpoint files: torch's archives that end in a checksum of their own, verified before they count and when read."""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import pickle
import pickletools
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins import CheckpointIO
from torch import Tensor

from hno.data.store import replace_whole

BEST = "best.ckpt"
"""Name of the best checkpoint inside a run's folder."""
LAST = "last.ckpt"
"""Name of the latest one."""
PREVIOUS = "previous.ckpt"
"""Name of the one before it."""
RESUMED = (LAST, PREVIOUS)
"""What a run goes on from, the newest first."""

PHYSICS = ("game.", "problem.")
"""What the names of an operator's entries begin with that are its game's."""

MARK = b"hno sha256 "
"""What stands before the digest, in the comment with which a zip archive ends."""
DIGITS = 64
DEEPEST, MOST = 32, 1_000_000
"""Levels and entries that the content of a checkpoint may have."""


class CheckpointError(RuntimeError):
    """A file that is not a readable checkpoint of this package, or is one of another game."""


def seal(content: Mapping[str, Any]) -> bytes:
    """An archive of torch, which `torch.load` reads as ever, with the SHA-256 of all bytes before it as its comment."""
    buffer = io.BytesIO()
    torch.save(content, buffer)
    body = buffer.getvalue()[:-2] + (len(MARK) + DIGITS).to_bytes(2, "little") + MARK
    return body + hashlib.sha256(body).hexdigest().encode()


def verified(path: Path) -> bytes:
    """The bytes of a checkpoint.

    Raises:
        CheckpointError: it cannot be read, has no checksum, or its content does not match it.
    """
    try:
        whole = path.read_bytes()
    except OSError as error:
        raise CheckpointError(f"{path} is not a readable checkpoint: {error.strerror or error}.") from error
    body, digest = whole[:-DIGITS], whole[-DIGITS:]
    if not body.endswith(MARK):
        raise CheckpointError(
            f"{path} is not a readable checkpoint: it does not end in a checksum, so it is truncated, damaged, not "
            "written by hno, or by a version before format 5. Use another one or train it again."
        )
    if hashlib.sha256(body).hexdigest().encode() != digest:
        raise CheckpointError(
            f"{path} is not a readable checkpoint: it is damaged, its content does not match its checksum. Use another "
            "one or train it again."
        )
    return whole


def write_checkpoint(content: Mapping[str, Any], path: Path) -> None:
    """Replace a checkpoint by a verified one; killed at any moment, there is a whole one. `LAST` becomes `PREVIOUS`.

    Raises:
        OSError: it cannot be written; the old ones stay.
    """
    sealed = seal(content)

    def write(draft: Path) -> None:
        with draft.open("wb") as file:
            file.write(sealed)
            file.flush()
            os.fsync(file.fileno())
        if draft.read_bytes() != sealed:
            raise OSError(f"{path} cannot be written: what was read back is not what was written.")
        if path.name == LAST and is_sound(path):
            path.replace(path.with_name(PREVIOUS))

    replace_whole(path, write)
    with contextlib.suppress(OSError):  # some file systems cannot sync a folder
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def is_sound(path: Path) -> bool:
    """Whether a file is there and matches its checksum."""
    try:
        verified(path)
    except CheckpointError:
        return False
    return True


def remove_drafts(folder: Path) -> None:
    """Remove what a killed process was writing in a folder that nobody else writes to."""
    for name in (BEST, LAST):
        for draft in folder.glob(f".{name}.*"):
            draft.unlink(missing_ok=True)


def read_content(path: Path) -> dict[str, Any]:
    """The content of a checkpoint, tensors and plain containers, on the CPU.

    Raises:
        CheckpointError: see `verified`; or it holds anything else, or unpacks to more than its size.
    """
    whole = verified(path)
    try:
        with zipfile.ZipFile(io.BytesIO(whole)) as archive:
            entries = archive.infolist()
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
                raise ValueError("its entries are compressed")
            if sum(entry.file_size for entry in entries) > len(whole):
                raise ValueError("its entries are larger than the file")
            for entry in entries:
                if entry.filename.endswith(".pkl"):
                    _check_tuples(archive.read(entry))
        content = torch.load(io.BytesIO(whole), map_location="cpu", weights_only=True)
        for item in leaves(content):
            if isinstance(item, Tensor):
                _check_memory(item)
    except UNFIT as error:
        raise CheckpointError(f"{path} is not a readable checkpoint: foreign or unsafe ({reason(error)}).") from error
    if not isinstance(content, dict):
        raise CheckpointError(f"{path} is not a readable checkpoint: it was not written by hno.")
    return content


def leaves(content: Any) -> Iterator[Any]:
    """Keys and whatever is no container in nested dictionaries and sequences.

    Raises:
        ValueError: there are more than `DEEPEST` levels or `MOST` entries.
    """
    stack, entries = [(content, 0)], 0
    while stack:
        item, depth = stack.pop()
        if isinstance(item, Mapping):
            yield from item
            parts = list(item.values())
        elif isinstance(item, (list, tuple, set)):
            parts = list(item)
        else:
            yield item
            continue
        entries += len(parts)
        if depth >= DEEPEST or entries > MOST:
            raise ValueError(f"its content has more than {DEEPEST} levels or {MOST} entries")
        stack.extend((part, depth + 1) for part in parts)


def _check_tuples(pickled: bytes) -> None:
    """Refuse a pickle with tuples of too many levels or entries, without unpickling it.

    Where such a tuple is the key of a dictionary, its hash takes for ever or more stack than there is.

    Raises:
        ValueError: it has; or it is no pickle.
    """
    mark = (-1, 0)
    stack, memo = list[tuple[int, int]](), dict[Any, tuple[int, int]]()
    for operation, argument, _ in pickletools.genops(pickled):
        name, taken, before = operation.name, list[tuple[int, int]](), list(operation.stack_before)
        if pickletools.markobject in before:
            while (top := stack.pop()) != mark:
                taken.append(top)
            before = before[: before.index(pickletools.markobject)]
        for _ in before:
            taken.append(stack.pop())
        depth = 1 + max((deep for deep, _ in taken), default=0)
        size = 1 + sum(size for _, size in taken)
        if name.startswith("TUPLE") and (depth > DEEPEST or size > MOST):
            raise ValueError(f"a tuple has more than {DEEPEST} levels or {MOST} entries")
        if "GET" in name:
            stack.append(memo[argument])
        elif "PUT" in name or name == "MEMOIZE":
            memo[len(memo) if name == "MEMOIZE" else argument] = taken[-1] if taken else stack[-1]
            stack += taken
        elif name.startswith("TUPLE") or not before:
            stack += [mark if each is pickletools.markobject else (depth, size) for each in operation.stack_after]
        else:  # a container that gets more entries is not one level deeper for each of them
            stack += [(max(taken[-1][0], *(1 + deep for deep, _ in taken[:-1]), 0), size)] * len(operation.stack_after)


def not_finite(content: Mapping[str, Any]) -> str | None:
    """The name of a weight, or the state of the optimizer, that is not finite; boxes of a game may be unbounded.

    Args:
        content: of a checkpoint.
    """
    skipped = tuple(f"operator.{name}" for name in PHYSICS)
    for name, weight in content["state_dict"].items():
        if not name.startswith(skipped) and not bool(weight.isfinite().all()):
            return str(name)
    states = (item for item in leaves(content.get("optimizer_states", [])) if isinstance(item, Tensor))
    return None if all(bool(item.isfinite().all()) for item in states) else "the state of the optimizer"


def _check_memory(tensor: Tensor) -> None:
    """Refuse tensors whose entries share memory: a few bytes would be billions of numbers."""
    size = tensor.numel() * tensor.element_size()
    if tensor.device.type != "cpu" or tensor.layout != torch.strided or size > tensor.untyped_storage().nbytes():
        raise ValueError("a tensor has more entries than the file")


def reason(error: BaseException) -> str:
    """An error in one short line."""
    lines = str(error).splitlines()
    text = lines[0] if lines else type(error).__name__
    return text if len(text) <= 200 else f"{text[:200]}..."


UNFIT = (
    ArithmeticError, AssertionError, AttributeError, EOFError, LookupError, MemoryError, NotImplementedError, OSError,
    RuntimeError, TypeError, ValueError, pickle.UnpicklingError, zipfile.BadZipFile,
)  # fmt: skip
"""What damaged, foreign or hostile content raises where it is unpickled or used."""


class CheckpointFiles(CheckpointIO):
    """Lightning's way to checkpoint files: all that a trainer saves and reads goes through the functions above."""

    latest: Path | None = None
    """The checkpoint that was written or read last."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """As `write_checkpoint`."""
        write_checkpoint(checkpoint, Path(path))
        self.latest = Path(path)

    def load_checkpoint(
        self, path: str | Path, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """As `read_content`."""
        self.latest = Path(path)
        return read_content(self.latest)

    def remove_checkpoint(self, path: str | Path) -> None:
        """Delete it."""
        Path(path).unlink(missing_ok=True)
