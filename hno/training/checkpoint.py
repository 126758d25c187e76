"""From a checkpoint to an operator or a policy, without executing anything in the file."""

from __future__ import annotations

import contextlib
import logging
import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, final

import torch
from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, ValidationError
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from hno.control.policy import Feedback
from hno.control.questions import X
from hno.games import Game, games, make
from hno.operators import Architecture, ValueOperator, make_operator
from hno.pontryagin.threads import torch_threads
from hno.registry import UnknownNameError
from hno.training.saving import BEST, LAST, PHYSICS, PREVIOUS, UNFIT, is_sound, leaves, not_finite, read_content, reason
from hno.training.saving import CheckpointError as CheckpointError
from hno.types import Numbers

log = logging.getLogger(__name__)

KEY = "hno"
"""Checkpoint entry that says how to build the operator and where it comes from."""
FORMAT = 7
"""Version of that entry."""


Draw = tuple[str, str, int | None]
"""What random states were for, their split, and their seed; None where it is unknown, as of labels brought along."""


@dataclass(frozen=True)
class Provenance:
    """Where an operator comes from: its method, its training types, and the hash of what its training depended on."""

    method: str = ""
    types: Sequence[tuple[float, ...]] = ()
    seed: int | None = None
    training_hash: str = ""
    draws: Sequence[Draw] | None = None
    """Every draw of random states that made the operator; None where nobody has listed them."""


def record(game: Game, architecture: Architecture, provenance: Provenance) -> dict[str, Any]:
    """What a checkpoint needs to rebuild its operator, plain containers under `KEY`."""
    content = {
        "format": FORMAT,
        "game": games.name_of(type(game)),
        "constants": dict(game.constants),
        "fingerprint": game.fingerprint(),
        "architecture": asdict(architecture),
        "provenance": asdict(provenance) | {"types": [tuple(map(float, theta)) for theta in provenance.types]},
    }
    return {KEY: content}


class _Record(BaseModel):
    """What `record` writes; nothing else is taken."""

    model_config = ConfigDict(extra="forbid")
    format: int
    game: str
    constants: dict[str, Any]
    fingerprint: str
    architecture: Architecture
    provenance: Provenance


class _TrainingState(BaseModel):
    """What Lightning adds to the weights for those who go on from them."""

    global_step: NonNegativeInt
    loops: dict[str, Any]
    optimizer_states: list[dict[Literal["state", "param_groups"], Any]] = Field(min_length=1, max_length=1)
    lr_schedulers: list[dict[str, Any]]
    callbacks: dict[str, Annotated[dict[str, Any], Field(min_length=1)]]


_LOOPS = {"epoch_loop.automatic_optimization.optim_progress", "epoch_loop.batch_progress", "epoch_progress"}
"""What Lightning needs to know where a training was."""
LONGEST = 1000
"""Characters that a text in the record may have."""


def find_checkpoint(path: str | Path, names: Sequence[str] = (BEST, LAST, PREVIOUS)) -> Path:
    """A checkpoint as people name it: a file, or the first of these names in a run's folder that is not damaged.

    Damaged ones that are passed over are logged.

    Raises:
        CheckpointError: there is none.
    """
    place = Path(path)
    files = [place / name for name in names] if place.is_dir() else [place]
    there = [file for file in files if file.is_file()]
    if there == [place]:
        return place
    for file in there:
        if is_sound(file):
            return file
        log.warning("%s is damaged and passed over.", file)
    if there:
        raise CheckpointError(f"Every checkpoint in {place} is damaged: {', '.join(f.name for f in there)}.")
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
        CheckpointError: no such file, damaged, or not written by this version of the package.
    """
    path = find_checkpoint(path)
    content = read_content(path)
    found = content.get(KEY)
    if not isinstance(found, dict) or not isinstance(content.get("state_dict"), dict):
        raise CheckpointError(f"{path} was not written by hno: its entry {KEY!r} is missing.")
    try:
        if not all(map(_plain, leaves(found))):
            raise ValueError("it holds more than short texts and finite numbers")
    except UNFIT as error:
        raise CheckpointError(f"{path} has a bad entry {KEY!r}: {reason(error)}. Train it again.") from error
    if found.get("format") != FORMAT:
        version = reason(ValueError(found.get("format")))
        raise CheckpointError(
            f"{path} has format {version}, this version of hno reads format {FORMAT}: train it again."
        )
    if missing := sorted(_Record.model_fields.keys() - found.keys()):
        raise CheckpointError(f"{path} is not complete: its entry {KEY!r} lacks {', '.join(missing)}. Train it again.")
    try:
        if _Record.model_validate(found).model_dump() != found:
            raise ValueError("an entry has another type")
    except UNFIT as error:
        raise CheckpointError(f"{path} has a bad entry {KEY!r}: {_reason(error)}. Train it again.") from error
    return content


def _plain(item: object) -> bool:
    """Whether it is what JSON has, of a sane size."""
    if isinstance(item, str):
        return len(item) <= LONGEST
    return item is None or (isinstance(item, (bool, int, float)) and abs(item) < math.inf)


def _reason(error: BaseException) -> str:
    """An error in one line; of those of a schema the first."""
    if isinstance(error, ValidationError):
        first = error.errors(include_input=False)[0]
        return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    return reason(error).removesuffix(".")


def check_resumable(path: str | Path, expected: Mapping[str, Any], steps: int | None = None) -> None:
    """Refuse to resume from a checkpoint whose record is not the expected one, as `record` gives it.

    Args:
        path: the checkpoint.
        expected: record of the run that is to go on.
        steps: length of that run, if it is known.

    Raises:
        CheckpointError: see `read_checkpoint` and `check_training_state`; or the checkpoint is of another game,
            operator or training.
    """
    content = read_checkpoint(path)
    found, wanted = flat(content[KEY]), flat(expected[KEY])
    differing = sorted(name for name in found.keys() | wanted.keys() if found.get(name) != wanted.get(name))
    if differing:
        pairs = "; ".join(f"{name} {found.get(name)!r}, expected {wanted.get(name)!r}" for name in differing)
        raise CheckpointError(f"{path} is a checkpoint of something else: {pairs}. Resume with its own configuration.")
    check_training_state(path, content, steps)


def check_training_state(path: str | Path, content: Mapping[str, Any], steps: int | None = None) -> None:
    """Refuse to go on from a checkpoint that lacks what a training needs besides the weights.

    Raises:
        CheckpointError: an entry is missing or inconsistent, weights are not finite, or it has taken more steps than
            the run has.
    """
    try:
        state = _TrainingState.model_validate(content)
        step, (optimizer,) = state.global_step, state.optimizer_states
        loops = state.loops["fit_loop"]
        if missing := sorted(_LOOPS - loops.keys()):
            raise ValueError(f"its loops lack {', '.join(missing)}")
        progress = loops["epoch_loop.automatic_optimization.optim_progress"]
        if progress["optimizer"]["step"]["total"]["completed"] != step:
            raise ValueError("its step is not that of its loops")
        trained = [number for group in optimizer["param_groups"] for number in group["params"]]
        if step and not (optimizer["state"] and set(optimizer["state"]) <= set(trained)):
            raise ValueError("its optimizer state is not that of its weights")
        if (name := not_finite(content)) is not None:
            raise ValueError(f"{name} is not finite")
    except UNFIT as error:
        message = f"{path} cannot be resumed from: {_reason(error)}. Resume from another one, or train again."
        raise CheckpointError(message) from error
    if steps is not None and step > steps:
        raise CheckpointError(f"{path} is at step {step}, the run ends at step {steps}. Set trainer.max_steps higher.")


def same_run(one: Path, other: Path) -> bool:
    """Whether two files are sound checkpoints with the same record; if the first is not, this is logged in one line."""
    if not one.exists():
        return False
    try:
        found, wanted = (read_content(path).get(KEY) for path in (one, other))
        if all(map(_plain, leaves([found, wanted]))) and found == wanted:
            return True
    except CheckpointError as error:
        log.warning("%s The run goes on from %s.", error, other)
        return False
    log.warning("%s is of another run than %s and is not used.", one, other)
    return False


def flat(content: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one, with dotted names."""
    found: dict[str, Any] = {}
    for name, value in content.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {prefix + name: value}
    return found


def load_operator(path: str | Path, game: str | None = None) -> tuple[ValueOperator, Architecture, Provenance]:
    """The trained operator in a checkpoint, in evaluation mode, what it is built of and where it comes from.

    Where a game is named, it must be of that one.

    Raises:
        CheckpointError: see `read_checkpoint`; or the checkpoint is of another game, its game has changed since, or its
            weights are not those of the operator that it describes.
        UnknownNameError: its game or a part of its operator is not registered here.
    """
    path = find_checkpoint(path)
    content = read_checkpoint(path)
    found = _Record.model_validate(content[KEY])
    if game is not None and found.game != game:
        raise CheckpointError(f"{path} is a checkpoint of game {found.game!r}, expected {game!r}.")
    if found.game not in games.names():
        raise UnknownNameError(
            f"{path} is of the game {found.game!r}, which is not registered here. If a script of your own registers "
            f"it, import that script first. Known: {', '.join(games.names())}."
        )
    prefix = "operator."
    try:
        built = make(found.game, **found.constants)
        same = built.fingerprint() == found.fingerprint
        if same and any(len(theta) != built.players for theta in found.provenance.types):
            raise ValueError("its types are not one per player")
    except UnknownNameError:
        raise
    except UNFIT as error:
        raise CheckpointError(f"{path} does not describe a game: {_reason(error)}.") from error
    if not same:
        raise CheckpointError(f"{path} was trained on another version of the game {found.game!r}. Train it again.")
    try:
        weights = {name.removeprefix(prefix): w for name, w in content["state_dict"].items() if name.startswith(prefix)}
        with _no_larger_than(weights):
            operator = make_operator(built, found.architecture)
        _fill(operator, weights)
    except UnknownNameError:
        raise
    except UNFIT as error:
        raise CheckpointError(
            f"{path} does not hold the weights that its own entry {KEY!r} describes: {_reason(error)}."
        ) from error
    return operator.eval().requires_grad_(False), found.architecture, found.provenance


@contextlib.contextmanager
def _no_larger_than(weights: Mapping[str, Tensor]) -> Iterator[None]:
    """Stop the building of modules, in this thread, that have many more parameters than these weights.

    They are not compared one by one, because a module may set a parameter that it then replaces.
    """
    count, numbers = 4 * len(weights), 4 * sum(weight.numel() for weight in weights.values())
    thread = threading.get_ident()

    def note(module: nn.Module, name: str, parameter: nn.Parameter | None) -> None:
        nonlocal count, numbers
        if threading.get_ident() == thread and parameter is not None:
            count, numbers = count - 1, numbers - parameter.numel()
            if count < 0 or numbers < 0:
                raise ValueError("it has fewer of them")

    handle = register_module_parameter_registration_hook(note)
    try:
        yield
    finally:
        handle.remove()


def _fill(operator: ValueOperator, weights: Mapping[str, Tensor]) -> None:
    """Load weights into an operator, whose game they must not change.

    Raises:
        ValueError, RuntimeError: they do not fit, are not finite, or would change the game.
    """
    built = {name: value.clone() for name, value in operator.state_dict().items()}
    for name, value in built.items():
        if name in weights and _kind(value) != _kind(weights[name]):
            raise ValueError(f"{name} is {weights[name].dtype}, expected {value.dtype}")
    operator.load_state_dict(weights)
    for name, value in operator.state_dict().items():
        if not torch.equal(value, built[name]):
            if name.startswith(PHYSICS):
                raise ValueError(f"{name} is not that of the game")
            if not bool(value.isfinite().all()):
                raise ValueError(f"{name} is not finite")
    if not all(bool((scale > 0).all()) for scale in operator.scales):
        raise ValueError("a scale is not positive")


def _kind(tensor: Tensor) -> object:
    """What kind of numbers it has, in any precision."""
    return "real" if tensor.is_floating_point() else tensor.dtype


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

    def origin(self) -> dict[str, Any]:
        """Names of its parts, training types, seed, and what was drawn for its training."""
        types, draws = [list(theta) for theta in self.types], self.provenance.draws
        drawn = None if draws is None else [list(draw) for draw in draws]
        return {"names": self.names(), "types": types, "seed": self.provenance.seed, "draws": drawn}


def load_policy(path: str | Path, game: str | None = None, threads: int = 1) -> LearnedPolicy:
    """The policy of the operator in a checkpoint. Arguments and errors as of `load_operator` and `LearnedPolicy`."""
    return LearnedPolicy(*load_operator(path, game), threads)
