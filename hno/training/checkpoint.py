"""From a checkpoint to an operator or a policy, without executing anything in the file."""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, final

import torch

from hno.control.policy import Feedback
from hno.control.questions import X
from hno.games import Game, games, make
from hno.operators import Architecture, Choice, ValueOperator, make_operator
from hno.pontryagin.threads import torch_threads
from hno.registry import UnknownNameError
from hno.types import Numbers

KEY = "hno"
"""Checkpoint entry that says how to build the operator and where it comes from."""
FORMAT = 4
"""Version of that entry."""


class CheckpointError(RuntimeError):
    """A file that is not a readable checkpoint of this package, or is one of another game."""


@dataclass(frozen=True)
class Provenance:
    """Where an operator comes from: its method, its training types, and the hash of what determined its numbers."""

    method: str = ""
    types: Sequence[tuple[float, ...]] = ()
    seed: int | None = None
    config_hash: str = ""


def record(game: Game, architecture: Architecture, provenance: Provenance) -> dict[str, Any]:
    """What a checkpoint needs to rebuild its operator, plain containers under `KEY`."""
    content = {
        "format": FORMAT,
        "game": games.name_of(type(game)),
        "constants": dict(game.constants),
        "fingerprint": game.fingerprint(),
        "architecture": asdict(architecture),
        "provenance": asdict(provenance),
    }
    return {KEY: content}


def find_checkpoint(path: str | Path, names: Sequence[str] = ("best.ckpt", "last.ckpt")) -> Path:
    """A checkpoint as people name it: a file, or the first of these names that a run's folder has.

    Raises:
        CheckpointError: there is none.
    """
    place = Path(path)
    files = [place / name for name in names] if place.is_dir() else [place]
    for file in files:
        if file.is_file():
            return file
    runs = sorted({file.parent.name for name in names for file in place.glob(f"*/{name}")})
    if runs:
        advice = f"{place} is the folder of a sweep: name one of its runs, such as {place / runs[0]}"
        raise CheckpointError(f"{advice}. It holds {', '.join(runs)}.")
    where = " or ".join(map(str, files))
    raise CheckpointError(f"There is no checkpoint at {where}. Train one with `hno train`, or name its folder.")


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """The content of a checkpoint, or of the best or last one in a run's folder.

    Only tensors and plain containers are unpickled.

    Raises:
        CheckpointError: no such file, truncated, or not written by this version of the package.
    """
    path = find_checkpoint(path)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except _UNREADABLE as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(
            f"{path} is not a readable checkpoint: truncated, foreign or unsafe ({reason})."
        ) from error
    found = content.get(KEY) if isinstance(content, dict) else None
    if not isinstance(found, dict) or "state_dict" not in content:
        raise CheckpointError(f"{path} was not written by hno: its entry {KEY!r} is missing.")
    if found.get("format") != FORMAT:
        raise CheckpointError(
            f"{path} has format {found.get('format')}, this version of hno reads format {FORMAT}: train it again."
        )
    if missing := sorted(_ENTRIES - found.keys()):
        raise CheckpointError(f"{path} is not complete: its entry {KEY!r} lacks {', '.join(missing)}. Train it again.")
    return content


_UNREADABLE = (
    AttributeError, EOFError, LookupError, OSError, RuntimeError, TypeError, ValueError, pickle.UnpicklingError,
    zipfile.BadZipFile,
)  # fmt: skip
"""What unpickling damaged or foreign bytes raises."""
_ENTRIES = {"game", "constants", "fingerprint", "architecture", "provenance"}
"""Entries that loading needs."""


def check_resumable(path: str | Path, expected: Mapping[str, Any]) -> None:
    """Refuse to resume from a checkpoint whose record is not the expected one, as `record` gives it.

    Raises:
        CheckpointError: see `read_checkpoint`; or the checkpoint is of another game, operator or configuration.
    """
    found, wanted = _flat(read_checkpoint(path)[KEY]), _flat(expected[KEY])
    differing = sorted(name for name in found.keys() | wanted.keys() if found.get(name) != wanted.get(name))
    if differing:
        pairs = "; ".join(f"{name} {found.get(name)!r}, expected {wanted.get(name)!r}" for name in differing)
        raise CheckpointError(f"{path} is a checkpoint of something else: {pairs}. Resume with its own configuration.")


def _flat(content: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one, with dotted names."""
    flat: dict[str, Any] = {}
    for name, value in content.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {prefix + name: value}
    return flat


def load_operator(path: str | Path, game: str | None = None) -> tuple[ValueOperator, Architecture, Provenance]:
    """The trained operator in a checkpoint, in evaluation mode, what it is built of and where it comes from.

    Where a game is named, it must be of that one.

    Raises:
        CheckpointError: see `read_checkpoint`; or the checkpoint is of another game, or its game has changed since.
        UnknownNameError: its game or a part of its operator is not registered here.
    """
    content = read_checkpoint(path)
    found = content[KEY]
    if game is not None and found["game"] != game:
        raise CheckpointError(f"{path} is a checkpoint of game {found['game']!r}, expected {game!r}.")
    if found["game"] not in games.names():
        raise UnknownNameError(
            f"{path} is of the game {found['game']!r}, which is not registered here. If a script of your own registers "
            f"it, import that script first. Known: {', '.join(games.names())}."
        )
    built = make(found["game"], **found["constants"])
    if built.fingerprint() != found["fingerprint"]:
        raise CheckpointError(f"{path} was trained on another version of the game {found['game']!r}. Train it again.")
    prefix = "operator."
    weights = {name.removeprefix(prefix): w for name, w in content["state_dict"].items() if name.startswith(prefix)}
    try:
        architecture = Architecture(**{part: Choice(**choice) for part, choice in found["architecture"].items()})
        provenance = Provenance(**found["provenance"])
        operator = make_operator(built, architecture)
        operator.load_state_dict(weights)
    except (RuntimeError, TypeError, AttributeError) as error:
        raise CheckpointError(f"{path} does not hold the weights that its own entry {KEY!r} describes.") from error
    return operator.eval().requires_grad_(False), architecture, provenance


@final
class LearnedPolicy(Feedback):
    """The policy of a trained operator, and where it comes from.

    Every answer takes so many `threads` of torch; one answer is too small for several.
    """

    def __init__(
        self, operator: ValueOperator, architecture: Architecture, provenance: Provenance, threads: int = 1
    ) -> None:
        super().__init__(operator)
        self.architecture, self.provenance, self.threads = architecture, provenance, threads

    def act(self, tau: Numbers, x: X, theta: Numbers) -> X:
        """As `Feedback.act`, on `threads` threads."""
        with torch_threads(self.threads):
            return super().act(tau, x, theta)

    def value(self, tau: Numbers, x: X, theta: Numbers) -> X:
        """As `Feedback.value`, on `threads` threads."""
        with torch_threads(self.threads):
            return super().value(tau, x, theta)

    def costate(self, tau: Numbers, x: X, theta: Numbers) -> X:
        """As `Feedback.costate`, on `threads` threads."""
        with torch_threads(self.threads):
            return super().costate(tau, x, theta)

    @property
    def types(self) -> list[tuple[float, ...]]:
        """Player types that it was trained with."""
        return [tuple(theta) for theta in self.provenance.types]

    def names(self) -> dict[str, str]:
        """Names of game, method, function and activation."""
        game, parts = games.name_of(type(self.game)), self.architecture
        chosen = {"function": parts.function.name, "activation": parts.activation.name}
        return {"game": game, "operator": self.provenance.method, **chosen}


def load_policy(path: str | Path, game: str | None = None, threads: int = 1) -> LearnedPolicy:
    """The policy of the operator in a checkpoint. Arguments and errors as of `load_operator` and `LearnedPolicy`."""
    return LearnedPolicy(*load_operator(path, game), threads)
