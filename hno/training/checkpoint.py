"""From a checkpoint to an operator or a policy, without executing anything in the file."""

from __future__ import annotations

import pickle
import zipfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hno.games import Game, make
from hno.operators.base import SPEC_FORMAT, SPEC_KEY, ValueOperator, operators
from hno.types import Points


class CheckpointError(RuntimeError):
    """A file that is not a readable checkpoint of this package, or is one of another game."""


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """The content of a checkpoint; only tensors and plain containers are unpickled.

    Raises:
        CheckpointError: no such file, truncated, or not written by this package.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise CheckpointError(f"There is no checkpoint at {path}. Train one with `python train.py`.") from error
    except _UNREADABLE as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(
            f"{path} is not a readable checkpoint: truncated, foreign or unsafe ({reason})."
        ) from error
    spec = content.get(SPEC_KEY) if isinstance(content, dict) else None
    known = isinstance(spec, dict) and spec.get("format") == SPEC_FORMAT and spec.keys() >= _ENTRIES
    if not known or "state_dict" not in content:
        raise CheckpointError(f"{path} was not written by this version of hno: its entry {SPEC_KEY!r} is not complete.")
    return content


_UNREADABLE = (
    AttributeError, EOFError, LookupError, OSError, RuntimeError, TypeError, ValueError, pickle.UnpicklingError,
    zipfile.BadZipFile,
)  # fmt: skip
"""What unpickling damaged or foreign bytes raises."""
_ENTRIES = {"game", "constants", "fingerprint", "operator", "options", "seen_types"}
"""Entries of a spec that loading needs."""


def check_resumable(path: str | Path, operator: ValueOperator) -> None:
    """Refuse to resume from a checkpoint that is not of this operator.

    Raises:
        CheckpointError: see `read_checkpoint`; or the checkpoint is of another game, operator or network.
    """
    found, expected = read_checkpoint(path)[SPEC_KEY], operator.spec()
    differing = [name for name in expected if name != "seen_types" and found.get(name) != expected[name]]
    if differing:
        pairs = "; ".join(f"{name} {found.get(name)!r}, expected {expected[name]!r}" for name in differing)
        raise CheckpointError(f"{path} is a checkpoint of something else: {pairs}. Resume with its own configuration.")


def load_operator(path: str | Path, game: str | None = None) -> ValueOperator:
    """The trained operator in a checkpoint, in evaluation mode.

    Args:
        path: a checkpoint that training wrote.
        game: the name of the game that it must be of; any, by default.

    Raises:
        CheckpointError: see `read_checkpoint`; or the checkpoint is of another game, or its game has changed since.
        UnknownNameError: its game or operator is not registered here.
    """
    content = read_checkpoint(path)
    spec = content[SPEC_KEY]
    if game is not None and spec["game"] != game:
        raise CheckpointError(f"{path} is a checkpoint of game {spec['game']!r}, expected {game!r}.")
    built = make(spec["game"], **spec["constants"])
    if built.fingerprint() != spec["fingerprint"]:
        raise CheckpointError(f"{path} was trained on another version of the game {spec['game']!r}. Train it again.")
    try:
        operator = operators.get(spec["operator"])(built, **spec["options"])
        operator.load_state_dict(content["state_dict"])
    except (RuntimeError, TypeError) as error:
        raise CheckpointError(f"{path} does not hold the weights that its own entry {SPEC_KEY!r} describes.") from error
    operator.seen_types = [tuple(theta) for theta in spec["seen_types"]]
    operator.seed = spec.get("seed")
    return operator.eval().requires_grad_(False)


class OperatorPolicy:
    """Feedback controls of every player: the maximiser of the Hamiltonian at the operator's costates.

    Args:
        operator: a trained operator.
    """

    def __init__(self, operator: ValueOperator) -> None:
        self.operator = operator

    @property
    def game(self) -> Game:
        """The game that the policy plays."""
        return self.operator.game

    def __call__(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """Controls in physical units, (B,), (B, P, n), (B, P) -> (B, P, m), in the floating-point type of `x`.

        Raises:
            ValueError: shapes do not fit the game or each other, or an entry is not finite.
        """
        batch, joint = x.shape[:-2], (self.game.players, self.game.state_dim)
        if x.shape[-2:] != joint or tau.shape != batch or theta.shape != (*batch, joint[0]):
            raise ValueError(
                f"Expected tau (B,), x (B, {joint[0]}, {joint[1]}) and theta (B, {joint[0]}); "
                f"got {tuple(tau.shape)}, {tuple(x.shape)} and {tuple(theta.shape)}."
            )
        self.game.check_theta(theta)
        if not bool(tau.isfinite().all() & x.isfinite().all()):
            raise ValueError("tau and x must be finite; a controller has no answer to NaN or infinite entries.")
        dtype = self.operator.value_scale.dtype
        points = Points(tau.to(dtype), x.to(dtype), theta.to(dtype))
        return self.game.optimal_control(points.x, self.operator.field(points).costate).to(x.dtype)


def load_policy(path: str | Path) -> OperatorPolicy:
    """The policy of the operator in a checkpoint. Raises as `load_operator`."""
    return OperatorPolicy(load_operator(path))
