"""Labels from and to other programs, as arrays."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.integrate import simpson
from torch import Tensor

from hno.data.soundness import flaw
from hno.data.store import LabelFileError, read_labels, write_labels
from hno.games import Game
from hno.games.base import own_costate
from hno.pontryagin.adjoint import terminal_costate
from hno.pontryagin.certificates import global_gap, local_gap, reintegration_error
from hno.pontryagin.collocation import Collocation, Iterate
from hno.pontryagin.starts import Search
from hno.types import Extremal, Status, join

CHUNK = 128
"""Rows whose certificates are computed together; bounds the memory."""
REQUIRED = ("t", "x", "costate", "value", "theta")
"""Arrays that labels of your own must have; shapes and units are those of `hno.types.Extremal`."""


def to_arrays(labels: Extremal) -> dict[str, NDArray[Any]]:
    """Labels as arrays, one per field of `hno.types.Extremal`."""
    return {name: tensor.numpy() for name, tensor in labels._asdict().items()}


def from_arrays(game: Game, arrays: Mapping[str, NDArray[Any]]) -> Extremal:
    """Labels from arrays, with certificates that are computed here.

    The re-integration error and the gaps see the trajectory as the cubic Hermite interpolant of its nodes: on a coarse
    grid they are larger than those of the program that the labels come from.

    Args:
        game: the game that the labels are of.
        arrays: at least `REQUIRED`; controls follow from the costates, and every row counts as converged.

    Raises:
        ValueError: a missing or unknown array, a wrong shape, numbers that are or become not finite, times that do not
            increase from 0 to the horizon, or values or costates that do not end at the terminal value and its
            gradient.
    """
    game = copy.deepcopy(game).cpu().double()
    wrong = [name for name in REQUIRED if name not in arrays] + [name for name in arrays if name not in REQUIRED]
    if wrong:
        raise ValueError(f"Labels consist of the arrays {', '.join(REQUIRED)}; missing or unknown: {', '.join(wrong)}.")
    t, x, costate, value, theta = (torch.from_numpy(np.array(arrays[name], dtype=np.float64)) for name in REQUIRED)
    with torch.inference_mode(False), torch.no_grad():
        _check(game, t, x, costate, value, theta)
        rows = (part.split(CHUNK) for part in (x, costate, value, theta))
        found = join([_certified(game, t, *part) for part in zip(*rows, strict=True)])
    if reason := flaw(found, game):
        raise ValueError(f"The game makes no labels of these arrays: {reason}.")
    return found


def _certified(game: Game, t: Tensor, x: Tensor, costate: Tensor, value: Tensor, theta: Tensor) -> Extremal:
    own, equations = own_costate(costate), Collocation(game)
    u = game.best_response(x, own)
    at = Iterate(t.expand(len(x), -1), torch.cat([x.flatten(-2), own.flatten(-2)], -1), theta)
    share = torch.linspace(0, 1, 9, dtype=t.dtype)
    between = equations.split(equations.interpolate(at, share))[0].flatten(1, 2)
    along = theta.unsqueeze(1).expand(between.shape[:-1])
    shared = torch.full_like(t.expand(len(x), -1), torch.nan)
    if game.potential:  # W is the sum of values, but for penalties that count once
        twice = game.uncontrolled_cost(between, along).sum(-1) - game.potential_cost(between, along)
        each = torch.from_numpy(simpson(twice.unflatten(-1, (-1, len(share))), dx=1 / (len(share) - 1))) * t.diff()
        shared = value.sum(-1) + torch.nn.functional.pad(each.flip(-1).cumsum(-1).flip(-1), (0, 1))
    return Extremal(
        status=torch.full((len(x),), int(Status.CONVERGED)),
        residual=torch.full((len(x),), torch.nan, dtype=torch.float64),
        t=t,
        x=x,
        costate=costate,
        u=u,
        value=value,
        theta=theta,
        potential=shared,
        start=torch.arange(len(x)),
        clearance=-game.constraint(between, along).amax((1, 2, 3)),
        reintegration=reintegration_error(game, at),
        local_gap=local_gap(game, at),
        global_gap=global_gap(game, x[:, 0], t, u, theta, Search()),
        alternatives=value[:, 0].sum(-1, keepdim=True),
    )


def _check(game: Game, t: Tensor, x: Tensor, costate: Tensor, value: Tensor, theta: Tensor) -> None:
    rows, nodes, players, states = len(x), len(t), game.players, game.state_dim
    shapes = {
        "t": (t, (nodes,)),
        "x": (x, (rows, nodes, players, states)),
        "costate": (costate, (rows, nodes, players, players, states)),
        "value": (value, (rows, nodes, players)),
        "theta": (theta, (rows, players)),
    }
    for name, (tensor, expected) in shapes.items():
        if tuple(tensor.shape) != expected or tensor.numel() == 0:
            raise ValueError(f"{name} must have shape {expected}, with rows; got {tuple(tensor.shape)}.")
        if not bool(tensor.isfinite().all()):
            raise ValueError(f"{name} has entries that are not finite.")
    if nodes < 2 or bool((t.diff() <= 0).any()) or abs(float(t[0])) > 1e-9 or abs(float(t[-1]) - game.horizon) > 1e-9:
        raise ValueError(f"t must increase from 0 to the horizon, {game.horizon} s; got {t.tolist()}.")
    end = game.terminal_value(x[:, -1])
    if not torch.allclose(value[:, -1], end, rtol=1e-3, atol=1e-3 * float(value.abs().max())):
        worst = float((value[:, -1] - end).abs().max())
        raise ValueError(
            f"value must end at the game's terminal value -g, it is off by up to {worst:.3g}: values are V = -J, in "
            "reward form, and x is in physical units."
        )
    end = terminal_costate(game, x[:, -1])
    if not torch.allclose(costate[:, -1], end, rtol=1e-3, atol=1e-3 * float(costate.abs().max())):
        worst = float((costate[:, -1] - end).abs().max())
        raise ValueError(
            f"costate must end at the gradient of the terminal value, it is off by up to {worst:.3g}: costates are "
            "dV_i / dx_j with V = -J."
        )


def write_own(path: Path, game: Game, labels: Extremal, source: str) -> None:
    """Write labels to a file that `data.files` takes.

    Args:
        path: the file.
        game: the game that the labels are of.
        labels: what `from_arrays` gives.
        source: where they come from, in words.
    """
    write_labels(path, labels, {**_identity(game), "source": source})


def read_own(path: Path, game: Game) -> Extremal:
    """Read labels that `write_own` or the label cache wrote.

    Raises:
        FileNotFoundError: there is no such file.
        LabelFileError: damaged, or labels of another game or of other constants, or none at all.
    """
    if not path.is_file():
        raise FileNotFoundError(f"There is no label file {path}. Write one with hno.data.exchange.write_own.")
    labels, provenance = read_labels(path)
    found = {name: provenance.get(name) for name in ("game", "fingerprint")}
    if found != _identity(game):
        raise LabelFileError(
            f"{path} holds labels of {found['game']} with other physics than {type(game).__name__} here."
        )
    if reason := flaw(labels, game):
        raise LabelFileError(f"{path} holds no labels of this game: {reason}.")
    return labels


def drawn_by(path: Path) -> tuple[str, int | None]:
    """Split and seed of the start states of a label file; its source and None where the label cache did not write it.

    Raises as `hno.data.store.read_labels`.
    """
    provenance = read_labels(path)[1]
    request = provenance.get("request")
    if isinstance(request, Mapping) and isinstance(request.get("seed"), int):
        return str(request.get("split")), int(request["seed"])
    return str(provenance.get("source", "unknown"))[:80], None


def _identity(game: Game) -> dict[str, str]:
    return {"game": type(game).__name__, "fingerprint": game.fingerprint()}
