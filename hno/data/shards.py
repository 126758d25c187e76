"""A set of labels as a folder of shards with a manifest, which several processes may fill at once."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from torch import Tensor

from hno.data.certificates import summary
from hno.data.folders import claimed, locked
from hno.data.soundness import flaw
from hno.data.store import (
    ADVICE,
    LabelFileError,
    canonical_json,
    checksum,
    read_labels,
    replace_whole,
    start_count,
    write_labels,
)
from hno.games import Game
from hno.types import Extremal, Status, join, of_starts

log = logging.getLogger(__name__)

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
        number = provenance.pop("shard", shard)  # files that are older do not say it
        if number != shard:
            raise LabelFileError(f"{self.path(shard)} is shard {number} of its set, under another name. {ADVICE}")
        if canonical_json(provenance) != canonical_json(self.provenance):
            raise LabelFileError(f"{self.path(shard)} was made by other settings than its folder says. {ADVICE}")
        return labels

    def sound(self, shard: int, game: Game, x0: Tensor | None) -> int:
        """How many start states of a shard are there. One that is damaged or of other starts is moved aside, and said.

        Args:
            shard: its number.
            game: what the labels are of.
            x0: the start states that it should have, or more or fewer of them, (S, P, n); None where nobody knows.

        Raises:
            LabelFileError: it is damaged, in a folder that cannot be written to.
        """
        try:
            return self._verified(shard, game, x0)
        except LabelFileError:
            if not os.access(self.folder, os.W_OK):
                raise
        path = self.path(shard)
        aside = path.with_name(f"{path.name}.damaged")
        with self._lock():
            try:
                return self._verified(shard, game, x0)  # another process has replaced it
            except LabelFileError as error:
                path.replace(aside)
                said = str(error).removesuffix(ADVICE)
                log.warning("%sIt is moved to %s, and its labels are solved again.", said, aside.name)
        return 0

    def _verified(self, shard: int, game: Game, x0: Tensor | None) -> int:
        if not self.path(shard).exists():
            return 0
        labels = self.read_shard(shard)
        if reason := flaw(labels, game):
            raise LabelFileError(f"{self.path(shard)} holds no labels of this game: {reason}. {ADVICE}")
        if x0 is not None:
            asked = (labels.status == Status.CONVERGED) & (labels.start < len(x0))
            apart = (labels.x[asked, 0] - x0[labels.start[asked]]) / game.state_box.width.cpu()
            if bool((apart.abs() > 1e-6).any()):
                raise LabelFileError(f"{self.path(shard)} holds other start states than were asked for. {ADVICE}")
        return labels.starts

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
            new, made = of_starts(labels, now - have), {**self.provenance, "shard": shard}
            write_labels(self.path(shard), join([self.read_shard(shard), new]) if now else new, made)

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
            replace_whole(self.folder / MANIFEST, lambda draft: draft.write_text(_signed(content)))

    def _shards(self) -> list[dict[str, Any]]:
        paths = sorted(self.folder.glob("shard-*.safetensors"))
        return [{"file": path.name, "rows": start_count(path), "sha256": checksum(path)} for path in paths]

    def _drafts(self) -> list[Path]:
        """Our own unfinished files, and those of safetensors, which writes beside the file that it is to write."""
        return [path for kind in (".shard-*.*", f".{MANIFEST}.*", ".tmp*") for path in sorted(self.folder.glob(kind))]

    def _listed(self) -> Any:
        """Shards that the manifest lists; None without one. A damaged one, or one without a checksum, is said."""
        path = self.folder / MANIFEST
        try:
            text = path.read_text()
            content = json.loads(text)
            if _signed(content) == text:
                return content["shards"]
        except FileNotFoundError:
            return None
        except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
            pass
        log.warning("%s is damaged, or older than its checksum: it is written again.", path)
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


class StoredLabels(Sequence[Extremal]):
    """Labels of several sets, each read whenever it is asked for: all of them need not fit into memory.

    Args:
        sets: where they are.
        starts: how many start states of each.
    """

    def __init__(self, sets: Sequence[LabelSet], starts: Sequence[int]) -> None:
        self.sets, self.starts = sets, starts

    def __len__(self) -> int:
        """How many sets."""
        return len(self.sets)

    def __getitem__(self, place: Any) -> Any:
        """The labels of a set."""
        return self.sets[place].read(self.starts[place])


def _signed(content: Mapping[str, Any]) -> str:
    """The text of a manifest with a checksum of its content; one that has a checksum already gets it anew."""
    bare = {name: entry for name, entry in content.items() if name != "sha256"}
    digest = hashlib.sha256(json.dumps(bare, sort_keys=True).encode()).hexdigest()
    return json.dumps({**bare, "sha256": digest}, indent=1, sort_keys=True) + "\n"


def _number(name: str) -> int:
    """Number of the shard in a file; a killed run may have left gaps between them."""
    return int(name.removeprefix("shard-").removesuffix(".safetensors"))
