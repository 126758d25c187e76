"""Labels on demand: start states by seed, solved where the cache lacks them."""

from __future__ import annotations

import hashlib
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import joblib
import torch
from torch import Tensor

from hno.data.store import canonical_json, read_labels, write_labels
from hno.games import Game
from hno.pontryagin.solve import Solver, join, solve
from hno.types import Extremal

SOLVER_VERSION = 1
"""Counted up when the solver's results change, which makes cached labels stale."""


class Request(NamedTuple):
    """A set of labels: `starts` start states of one type, drawn by `seed`."""

    theta: tuple[float, ...]
    """Player types."""
    starts: int
    """Number of start states."""
    seed: int
    """Seed of the start states."""
    split: str
    """What the states are for, "train" or "test": different splits never share states."""
    widen: float = 1.0
    """Width of the start box in units of the game's."""


Progress = Callable[[int, int], None]
"""Called with (states done, states in all)."""


def default_cache() -> Path:
    """$HNO_CACHE, or the user's cache folder."""
    fallback = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "hno"
    return Path(os.environ.get("HNO_CACHE", fallback))


def start_states(game: Game, request: Request) -> Tensor:
    """Uniform start states of a request, float64, (starts, P, n)."""
    text = canonical_json({"seed": request.seed, "split": request.split, "theta": request.theta})
    generator = torch.Generator().manual_seed(int(hashlib.sha256(text.encode()).hexdigest()[:15], 16))
    return game.initial_box.widened(request.widen).cpu().sample(request.starts, generator).double()


def labels_for(
    game: Game,
    requests: Sequence[Request],
    cache: Path,
    settings: Solver = Solver(),
    workers: int | None = None,
    progress: Progress | None = None,
) -> tuple[list[Extremal], float]:
    """Labels of every request, read from the cache or solved and written to it.

    Args:
        game: the game.
        requests: what is needed.
        cache: folder of label files.
        settings: solver settings, part of the cache key.
        workers: processes with one thread each; the number of cores by default.
        progress: called as states are solved.

    Returns:
        One `Extremal` per request, failed rows included, and the seconds spent on solving.

    Raises:
        LabelFileError: a cached file is damaged.
    """
    began = time.perf_counter()
    paths = [label_path(game, request, cache, settings) for request in requests]
    missing = [index for index, path in enumerate(paths) if not path.exists()]
    found: dict[int, Extremal] = {i: read_labels(path)[0] for i, path in enumerate(paths) if i not in missing}
    if missing:
        _check_writable(cache)
    jobs = [(i, part) for i in missing for part in start_states(game, requests[i]).split(settings.chunk)]
    pieces: dict[int, list[Extremal]] = {i: [] for i in missing}
    waiting = {i: sum(job[0] == i for job in jobs) for i in missing}
    done, total = 0, sum(len(part) for _, part in jobs)
    for (index, part), piece in zip(jobs, _solve_all(game, requests, jobs, settings, workers), strict=True):
        pieces[index].append(piece)
        done += len(part)
        if progress is not None:
            progress(done, total)
        if len(pieces[index]) == waiting[index]:
            found[index] = join(pieces.pop(index))
            write_labels(paths[index], found[index], provenance(game, requests[index], settings))
    return [found[i] for i in range(len(requests))], time.perf_counter() - began


def _check_writable(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OSError(
            f"Labels cannot be written to {folder} ({error}). Choose another folder with $HNO_CACHE."
        ) from error


def label_path(game: Game, request: Request, cache: Path, settings: Solver) -> Path:
    """File of a request; its name holds a hash of everything that determines the labels."""
    key = hashlib.sha256(canonical_json(provenance(game, request, settings)).encode()).hexdigest()[:16]
    types = "-".join(f"{t:g}" for t in request.theta)
    return cache / type(game).__name__ / f"{types}_{request.split}{request.seed}_n{request.starts}_{key}.safetensors"


def provenance(game: Game, request: Request, settings: Solver) -> dict[str, Any]:
    """Everything that determines the labels of a request."""
    return {
        "game": type(game).__name__,
        "fingerprint": game.fingerprint(),
        "request": request._asdict(),
        "solver": _plain(settings),
        "solver_version": SOLVER_VERSION,
    }


def _plain(settings: Any) -> Any:
    if hasattr(settings, "_asdict"):
        return {name: _plain(value) for name, value in settings._asdict().items()}
    return list(settings) if isinstance(settings, tuple) else settings


def _solve_all(
    game: Game, requests: Sequence[Request], jobs: Sequence[tuple[int, Tensor]], settings: Solver, workers: int | None
) -> Any:
    workers = min(workers or os.cpu_count() or 1, len(jobs))
    types = [torch.tensor(request.theta, dtype=torch.float64) for request in requests]
    tasks = ((game, part, types[i].expand(len(part), -1), settings) for i, part in jobs)
    if workers <= 1:
        return (solve(*task) for task in tasks)
    pool = joblib.Parallel(n_jobs=workers, return_as="generator", inner_max_num_threads=1, backend="loky")
    return pool(joblib.delayed(_solve_alone)(*task) for task in tasks)


def _solve_alone(game: Game, x0: Tensor, theta: Tensor, settings: Solver) -> Extremal:
    torch.set_num_threads(1)
    return solve(game, x0, theta, settings)
