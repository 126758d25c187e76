"""Export: trace, write, check against the operator in double precision, and only then put into place."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hno.export.c_files import MANY, c_files
from hno.export.graph import Program
from hno.export.numpy_source import numpy_files
from hno.export.onnx_model import onnx_files
from hno.export.torch_program import torch_files
from hno.export.trace import Traced, answers, answers_at_one_state, for_any_batch, in_double, points, traced
from hno.games import Game, games
from hno.operators.base import ValueOperator
from hno.registry import UnknownNameError
from hno.runtime.artefact import FORMAT, MANIFEST, Artefact, signed
from hno.runtime.load import load
from hno.types import ROUNDING

TOLERANCE = 1e-5
"""Largest error that an artefact may have, relative to the largest entry of the output."""
SILENT = 0.1
"""Largest share of the questions that may say nothing."""
POINTS = 1000
"""Random questions by which every artefact is checked."""
NUDGE, JUMP, TIE = 1e-4, 1e-4, 2e-6
"""Where the operator's answers at two points, `NUDGE` of the boxes to both sides of a question, miss that in between by
more than `JUMP` on average, a sensor switches or another branch is taken; where branches differ by less than `TIE` of
the largest value, rounding decides between them. Errors mean nothing there."""


class ExportError(RuntimeError):
    """A controller that is not written: the artefact is not what the operator is, or has no place."""


def _numpy(operator: ValueOperator, about: Mapping[str, Any]) -> Mapping[str, str]:
    return numpy_files(*programs(operator), operator.game, _heading(about))


def programs(operator: ValueOperator) -> tuple[Program, Program]:
    """For any batch, and for one state."""
    return for_any_batch(operator), traced(answers(operator), operator.game, 1)


def _c(operator: ValueOperator, about: Mapping[str, Any]) -> Mapping[str, str]:
    one, many = answers(operator), answers_at_one_state(operator)

    def both(tau: Tensor, x: Tensor, theta: Tensor) -> dict[str, Tensor]:
        return one(tau, x, theta) | {MANY + name: part for name, part in many(tau, x, theta).items()}

    return c_files(traced(both, operator.game, 1), operator.game, _heading(about))


def _onnx(operator: ValueOperator, about: Mapping[str, Any]) -> Mapping[str, bytes]:
    return onnx_files(*programs(operator), about)


def _torch(operator: ValueOperator, about: Mapping[str, Any]) -> Mapping[str, bytes]:
    return torch_files(*programs(operator))


KINDS: dict[str, Callable[[ValueOperator, Mapping[str, Any]], Mapping[str, str | bytes]]] = {
    "numpy": _numpy, "c": _c, "onnx": _onnx, "torch": _torch,
}  # fmt: skip
"""What can be written: from an operator in double precision and the manifest to the contents of files."""


def export(operator: ValueOperator, to: str, folder: str | Path, origin: Mapping[str, Any] | None = None) -> Path:
    """Write a controller: value, costates, time derivatives and controls of an operator, for any batch.

    It is compared with the operator in double precision at random points first. Written is the whole folder or nothing;
    an earlier export at the same place is replaced.

    Args:
        operator: a trained operator.
        to: one of `KINDS`.
        folder: where; new, empty, or an earlier export.
        origin: where the operator comes from, plain containers, for the manifest.

    Returns:
        The folder.

    Raises:
        UnsupportedError: the game or the network has an operation that cannot be exported.
        ExportError: the folder holds something else, a package is missing, or the artefact is not accurate.
        ArtefactError: it cannot be checked here, for want of a compiler or a package.
    """
    place = Path(folder)
    if to not in KINDS:
        raise ExportError(f"A controller can be exported to {', '.join(KINDS)}; got {to!r}.")
    if place.exists() and not (place.is_dir() and ((place / MANIFEST).exists() or not any(place.iterdir()))):
        raise ExportError(f"{place} holds something else than an exported controller: name a new folder.")
    double = in_double(operator)
    about = _about(operator, to, origin or {})
    try:
        files = KINDS[to](double, about)
    except ModuleNotFoundError as error:
        raise ExportError(f"Writing {to} needs the package {error.name}: pip install 'hno[export]'.") from error
    place.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=place.parent, prefix=f".{place.name}.") as made:
        draft = Path(made) / "new"
        draft.mkdir()
        _fill(draft, files, about)
        checked = check(load(draft), double)
        if checked.error > TOLERANCE or checked.left_out > SILENT:
            raise ExportError(
                f"The controller for {to} is not written: it differs from the operator by {checked.error:.1e} of the "
                f"largest entry ({TOLERANCE:g} are allowed), and {checked.left_out:.1%} of the questions say nothing "
                f"({SILENT:.0%} are allowed)."
            )
        _fill(draft, files, about | {"errors": checked.errors, "left_out": checked.left_out})
        if place.exists():
            place.rename(Path(made) / "old")
        draft.rename(place)
    return place


def _fill(folder: Path, files: Mapping[str, str | bytes], about: Mapping[str, Any]) -> None:
    contents = {name: text.encode() if isinstance(text, str) else text for name, text in files.items()}
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    sums = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    (folder / MANIFEST).write_text(signed({**about, "files": sums}), encoding="utf-8")


def _about(operator: ValueOperator, kind: str, origin: Mapping[str, Any]) -> dict[str, Any]:
    """The manifest but for the files."""
    game = operator.game
    one = (part.to(operator.value_scale) for part in points(game, 1, 0).values())
    outputs = {name: list(part.shape[1:]) for name, part in answers(operator)(*one).items()}
    boxes = {name: _ends(getattr(game, name)) for name in ("state_box", "type_box", "control_box", "initial_box")}
    return {
        "format": FORMAT, "kind": kind, "version": metadata.version("hno"), "game": _name(game),
        "constants": dict(game.constants), "fingerprint": game.fingerprint(), "potential": operator.potential,
        "players": game.players, "states": game.state_dim, "controls": game.control_dim, "horizon": game.horizon,
        "rounding": ROUNDING, **boxes, "origin": dict(origin), "outputs": outputs,
        "units": {"tau": "s", "constraint": game.constraint_unit, "others": "the game's"},
    }  # fmt: skip


def _ends(box: Any) -> list[Any]:
    return [box.lo.tolist(), box.hi.tolist()]


def _name(game: Game) -> str:
    try:
        return games.name_of(type(game))
    except UnknownNameError:
        return type(game).__qualname__


def _heading(about: Mapping[str, Any]) -> str:
    constants = "".join(f", {name} = {value}" for name, value in about["constants"].items())
    return f"Controller of the game {about['game']}{constants}, written by hno {about['version']}."


class Checked(NamedTuple):
    """How far an artefact is from its operator."""

    errors: dict[str, float]
    """Largest error of each output, relative to its largest entry."""
    left_out: float
    """Share of the questions at which the operator itself jumps."""

    @property
    def error(self) -> float:
        """The largest one; infinite where an answer is missing."""
        return max(error if np.isfinite(error) else np.inf for error in self.errors.values())


def check(artefact: Artefact, operator: ValueOperator, size: int = POINTS, seed: int = 1) -> Checked:
    """Compare an artefact with an operator in double precision at random points of its boxes.

    Some of the questions are asked one by one.
    """
    asked = points(operator.game, size, seed)
    wanted = _said(answers(operator), asked)
    steady = _steady(operator, asked, wanted, seed)
    single = [part.float().numpy() for part in asked.values()]
    found = artefact.answers(*single)
    errors = {name: float(_distance(found[name], part)[steady].max() / _size(part)) for name, part in wanted.items()}
    for row in np.flatnonzero(steady)[:: max(1, size // 20)]:
        for name, part in artefact.answers(*(column[row : row + 1] for column in single)).items():
            distance = float(_distance(part, wanted[name][row : row + 1]).max())
            errors[name] = max(errors[name], distance / _size(wanted[name]))
    return Checked(errors, float(1 - steady.mean()))


def _steady(
    operator: ValueOperator, asked: Mapping[str, Tensor], wanted: Mapping[str, NDArray[Any]], seed: int
) -> NDArray[np.bool_]:
    """At which questions nothing jumps, see `NUDGE`."""
    game, generator = operator.game, torch.Generator().manual_seed(seed)
    widths = {"tau": torch.tensor(game.horizon), "x": game.state_box.width, "theta": game.type_box.width}
    steady = np.ones(len(asked["tau"]), bool)
    if "branches" in wanted and wanted["branches"].shape[1] > 1:
        second, best = np.partition(wanted["branches"], (-2, -1), axis=1)[:, -2:].T
        steady &= best - second > TIE * _size(wanted["branches"])
    for _ in range(4):
        step = {
            name: NUDGE * widths[name] * torch.randn(part.shape, generator=generator) for name, part in asked.items()
        }
        low, high = (
            _said(answers(operator), {name: asked[name] + sign * step[name] for name in asked}) for sign in (-1, 1)
        )
        for name, part in wanted.items():
            steady &= ~(_distance((low[name] + high[name]) / 2, part) > JUMP * _size(part))
    return steady


def _said(function: Traced, asked: Mapping[str, Tensor]) -> dict[str, NDArray[Any]]:
    return {name: part.detach().numpy() for name, part in function(*asked.values()).items()}


def _distance(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    """Largest difference in each row; 0 where both are infinite alike."""
    with np.errstate(invalid="ignore"):
        return np.where(a == b, 0, np.abs(a - b)).reshape(len(b), -1).max(-1)


def _size(part: NDArray[Any]) -> float:
    return float(np.abs(part[np.isfinite(part)]).max(initial=1e-30))
