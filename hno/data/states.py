"""Equilibria from any states with any time to go, kept like labels."""

from __future__ import annotations

import copy
import hashlib
import logging
from pathlib import Path

import numpy as np
from torch import Tensor

from hno.data.labels import Report, Request, provenance
from hno.data.many import solve_many
from hno.data.store import LabelFileError, canonical_json, read_labels, write_labels
from hno.games import Game
from hno.pontryagin.solve import Solver
from hno.types import Extremal

log = logging.getLogger(__name__)


def equilibria_from(
    game: Game,
    x0: Tensor,
    theta: Tensor,
    tau: float,
    cache: Path,
    settings: Solver = Solver(),
    workers: int | None = None,
    report: Report | None = None,
) -> Extremal:
    """The cheapest equilibrium from every state, read from the cache or solved and written to it.

    Args:
        game: the game.
        x0: states, (B, P, n).
        theta: types, (B, P).
        tau: time to go, s: the game from now on is one of this horizon.
        cache: folder of label files.
        settings: of the solver, part of the cache key.
        workers: processes with one thread each; as many as the job has cores by default.
        report: called as states are solved.

    Returns:
        One extremal per state, failed ones included.
    """
    left = copy.deepcopy(game).cpu()
    left.horizon = tau
    content = provenance(left, Request(tuple(theta[0].tolist()), len(x0), 0, "states"), settings)
    content |= {"states": _digest(x0), "types": _digest(theta), "tau": tau}
    key = hashlib.sha256(canonical_json(content).encode()).hexdigest()[:16]
    path = cache / type(game).__name__ / f"states_{key}.safetensors"
    if path.exists():
        try:
            return read_labels(path)[0]
        except LabelFileError as error:
            log.warning("%s They are solved again.", error)
    found = solve_many(left, x0, theta, settings, workers, report)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_labels(path, found, content)
    return found


def _digest(numbers: Tensor) -> str:
    return hashlib.sha256(np.ascontiguousarray(numbers.detach().cpu().double().numpy(), "<f8").tobytes()).hexdigest()
