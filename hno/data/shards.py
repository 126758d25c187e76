"""A set of labels as a folder of shards with a manifest, which several processes may fill at once."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from hno.data.certificates import summary
from hno.data.folders import claimed, locked
from hno.data.store import (
    LabelFileError,
    canonical_json,
    checksum,
    read_labels,
    replace_whole,
    start_count,
    write_labels,
)
from hno.types import Extremal, join, of_starts

SHARD = 128
"""Start states of a shard; the last one of a set may hold fewer until the set grows."""
MANIFEST = "manifest.json"
"""The manifest's name inside the folder of a set."""


@dataclass(frozen=True)
class LabelSet:
    """Labels of one game, type and seed in files of `SHARD` start states, each written whole or not at all.

    Args:
        folder: where the shards are.
        provenance: what determines the labels, JSON content.
    """

    folder: Path
    provenance: Mapping[str, Any] = field(compare=False)

    def path(self, shard: int) -> Path:
        """File of a shard."""
        return self.folder / f"shard-{shard:05}.safetensors"

    def starts(self, shard: int) -> int:
        """How many start states of a shard are there, by its header; its content is verified when it is read."""
        path = self.path(shard)
        return start_count(path) if path.exists() else 0

    def read_shard(self, shard: int) -> Extremal:
        """The rows of a shard.

        Raises:
            LabelFileError: damaged, or made by other settings than its folder says.
        """
        labels, provenance = read_labels(self.path(shard))
        if canonical_json(provenance) != canonical_json(self.provenance):
            raise LabelFileError(f"{self.path(shard)} was made by other settings than its folder says. Move it away.")
        return labels

    def read(self, starts: int) -> Extremal:
        """The labels of the first start states of the set.

        Raises:
            LabelFileError: a shard is damaged, or there are fewer start states than asked for.
        """
        found = []
        for shard in range((starts - 1) // SHARD + 1):
            wanted = min(SHARD, starts - shard * SHARD)
            labels = self.read_shard(shard)
            if labels.starts < wanted:
                raise LabelFileError(f"{self.path(shard)} holds {labels.starts} start states, expected {wanted}.")
            found.append(of_starts(labels, 0, wanted))
        return join(found)

    def append(self, shard: int, have: int, labels: Extremal) -> None:
        """Add start states to a shard that had `have` of them. What another process added first is kept.

        Raises:
            LabelFileError: the shard has fewer of them than it had.
        """
        with self._lock():
            now = self.starts(shard)
            if now < have:
                raise LabelFileError(f"{self.path(shard)} shrank from {have} to {now} start states. Run again.")
            if now >= have + labels.starts:
                return
            new = of_starts(labels, now - have)
            write_labels(self.path(shard), join([self.read_shard(shard), new]) if now else new, self.provenance)

    def write_manifest(self) -> None:
        """Write down which shards there are, with their checksums and how far their labels can be trusted."""
        current = self._listed() == self._shards() and not self._drafts()
        if current or not os.access(self.folder, os.W_OK):  # a read-only cache can still be read
            return
        with self._lock():
            for draft in self._drafts():  # left by a killed process: who writes holds the lock
                draft.unlink()
            for left in self.folder.glob(".claim-*"):
                with claimed(left):  # which removes it, if nobody is solving
                    pass
            shards = self._shards()
            found = [self.read_shard(_number(shard["file"])) for shard in shards]
            content = {
                "provenance": self.provenance,
                "versions": {name: version(name) for name in ("hno", "torch")},
                "shards": shards,
                "summary": summary(join(found)),
            }
            text = json.dumps(content, indent=1, sort_keys=True) + "\n"
            replace_whole(self.folder / MANIFEST, lambda draft: draft.write_text(text))

    def _shards(self) -> list[dict[str, Any]]:
        paths = sorted(self.folder.glob("shard-*.safetensors"))
        return [{"file": path.name, "rows": start_count(path), "sha256": checksum(path)} for path in paths]

    def _drafts(self) -> list[Path]:
        """Our own unfinished files, and those of safetensors, which writes beside the file that it is to write."""
        return [path for kind in (".shard-*.*", f".{MANIFEST}.*", ".tmp*") for path in sorted(self.folder.glob(kind))]

    def _listed(self) -> Any:
        try:
            return json.loads((self.folder / MANIFEST).read_text())["shards"]
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def check_writable(self) -> None:
        """Raise OSError, with advice, where the folder cannot be written to."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self.folder):
                pass
        except OSError as error:
            raise OSError(
                f"Labels cannot be written to {self.folder} ({error}). Choose another folder with $HNO_CACHE."
            ) from error

    def claim_path(self, shard: int) -> Path:
        """Lock file of who solves a shard."""
        return self.folder / f".claim-{shard:05}"

    def claim(self, shard: int) -> AbstractContextManager[bool]:
        """Whether a shard is for this process to solve, in the block; no other process solves it meanwhile."""
        return claimed(self.claim_path(shard))

    def _lock(self) -> AbstractContextManager[None]:
        return locked(self.folder / ".lock")


def _number(name: str) -> int:
    """Number of the shard in a file; a killed run may have left gaps between them."""
    return int(name.removeprefix("shard-").removesuffix(".safetensors"))
