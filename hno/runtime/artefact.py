"""What an exported controller is: a folder with a manifest, whose files are checked before anything is run."""

from __future__ import annotations

import abc
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

MANIFEST = "manifest.json"
FORMAT = 1
"""Version of the manifest."""
ENTRIES = {
    "kind": str, "game": str, "fingerprint": str, "constants": dict, "origin": dict, "outputs": dict, "files": dict,
    "players": int, "states": int, "controls": int, "potential": bool, "horizon": float, "rounding": float,
    "state_box": list, "type_box": list, "control_box": list,
}  # fmt: skip
"""What a manifest says, and of which type."""


class ArtefactError(RuntimeError):
    """A folder that is no exported controller, is damaged or of another version, or cannot run here."""


def signed(content: Mapping[str, Any]) -> str:
    """JSON with the SHA-256 of everything else in it."""
    plain = {name: entry for name, entry in content.items() if name != "sha256"}
    digest = hashlib.sha256(json.dumps(plain, sort_keys=True, allow_nan=False).encode()).hexdigest()
    return json.dumps({**plain, "sha256": digest}, indent=1, allow_nan=False)


def read_manifest(folder: str | Path) -> dict[str, Any]:
    """The manifest of an exported controller, all of whose files are as they were written.

    Raises:
        ArtefactError: they are not, or there is none, or it has another format.
    """
    place = Path(folder)
    try:
        content = json.loads((place / MANIFEST).read_text(encoding="utf-8"))
        if not isinstance(content, dict) or signed(content) != signed({**content, "sha256": ""}):
            raise ValueError("no manifest")
        found = json.loads(signed(content))["sha256"] == content.get("sha256")
    except OSError as error:
        raise ArtefactError(f"{place} is no exported controller: {error}. Export one with `hno export`.") from error
    except (ValueError, RecursionError) as error:
        raise ArtefactError(f"{place / MANIFEST} is damaged. Export the controller again.") from error
    if not found:
        raise ArtefactError(
            f"{place / MANIFEST} is damaged: it does not match its checksum. Export the controller again."
        )
    if content.get("format") != FORMAT:
        raise ArtefactError(
            f"{place} has format {content.get('format')!r:.20}, this version reads format {FORMAT}: export it again."
        )
    if wrong := [name for name, kind in ENTRIES.items() if type(content.get(name)) is not kind]:
        raise ArtefactError(f"{place / MANIFEST} was not written by hno: it has no sound {', '.join(wrong)}.")
    for name, digest in content["files"].items():
        if Path(name).name != name:
            raise ArtefactError(f"{place / MANIFEST} was not written by hno: {name!r:.80} is no name of a file.")
        _check(place / name, digest)
    return content


def _check(file: Path, digest: str) -> None:
    try:
        same = hashlib.sha256(file.read_bytes()).hexdigest() == digest
    except OSError as error:
        raise ArtefactError(f"{file} cannot be read: {error.strerror}. Export the controller again.") from error
    if not same:
        raise ArtefactError(f"{file} is damaged: it does not match its checksum. Export the controller again.")


class Artefact(abc.ABC):
    """An exported controller that answers questions of any batch.

    Args:
        about: its manifest.
    """

    def __init__(self, about: Mapping[str, Any]) -> None:
        self.about = dict(about)

    def answers(self, tau: ArrayLike, x: ArrayLike, theta: ArrayLike) -> dict[str, NDArray[np.float32]]:
        """Everything that it says of states, in single precision, by the names in its manifest.

        An answer that is not finite, far outside the PDE box, is NaN or infinite here.

        Args:
            tau: times to go, (B,), s.
            x: states, (B, P, n).
            theta: types, (B, P).

        Raises:
            ValueError: shapes that do not fit, entries that are not finite, times outside the horizon.
        """
        players, states = self.about["players"], self.about["states"]
        given = [np.ascontiguousarray(part, np.float32) for part in (tau, x, theta)]
        rows = given[0].shape[0] if given[0].ndim == 1 else -1
        shapes = [part.shape for part in given]
        if shapes != [(rows,), (rows, players, states), (rows, players)]:
            raise ValueError(f"Expected tau (B,), x (B, {players}, {states}) and theta (B, {players}); got {shapes}.")
        if not all(np.isfinite(part).all() for part in given):
            raise ValueError("tau, x and theta must be finite; a controller has no answer to NaN or infinite entries.")
        horizon, margin = self.about["horizon"], self.about["horizon"] * self.about["rounding"]
        if rows and not (-margin <= given[0].min() and given[0].max() <= horizon + margin):
            raise ValueError(f"tau is the time to go, from 0 to the horizon of {horizon:g} s.")
        if rows == 0:
            return {name: np.zeros((0, *shape), np.float32) for name, shape in self.about["outputs"].items()}
        return self._answers(*given)

    def many(self, theta: ArrayLike) -> Many:
        """The controls that many types have at one state, (K, P).

        Raises:
            ValueError: another shape, or entries that are not finite.
        """
        types = np.array(theta, np.float32, order="C")  # a copy, whose rows C reads one after the other
        if types.ndim != 2 or types.shape[1] != self.about["players"] or not np.isfinite(types).all():
            raise ValueError(f"types must be finite, of shape (K, {self.about['players']}); got {types.shape}.")
        return self._many(types)

    def _many(self, theta: NDArray[np.float32]) -> Many:
        """As `many`, of sound types: a batch of equal states, where a kind knows no better."""
        return Many(self, theta)

    @abc.abstractmethod
    def _answers(
        self, tau: NDArray[np.float32], x: NDArray[np.float32], theta: NDArray[np.float32]
    ) -> dict[str, NDArray[np.float32]]:
        """As `answers`, of a sound question with at least one row."""


class Many:
    """The controls that many types have at one state.

    Args:
        artefact: the controller.
        theta: types, (K, P), float32.
    """

    def __init__(self, artefact: Artefact, theta: NDArray[np.float32]) -> None:
        self._artefact, self._theta = artefact, theta

    def replace(self, row: int, theta: NDArray[Any]) -> None:
        """Other types (P,) in the place of some.

        Raises:
            ValueError: an entry is not finite.
        """
        if not np.isfinite(theta).all():
            raise ValueError(f"types must be finite; got {theta}.")
        self._theta[row] = theta

    def __call__(self, tau: float, x: ArrayLike) -> NDArray[np.float32]:
        """Controls (K, P, m) with tau seconds to go at states (P, n).

        Raises:
            ValueError: the controller refuses the question, see `Artefact.answers`, or has no finite answer.
        """
        count = len(self._theta)
        states = np.broadcast_to(np.asarray(x, np.float32), (count, *np.shape(x)))
        found = self._artefact.answers(np.full(count, tau, np.float32), states, self._theta)["control"]
        if not np.isfinite(found).all():
            raise ValueError("There is no finite control at this state: it is too far outside the PDE box.")
        return found
