"""Labels on demand: start states by seed, solved where the cache lacks them."""

from __future__ import annotations

import hashlib
import inspect
import math
import os
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import joblib
import torch
from torch import Tensor

from hno.data.certificates import CLEARANCE, safe
from hno.data.folders import POLL, Waiting, check_room
from hno.data.shards import SHARD, LabelSet, StoredLabels
from hno.data.store import canonical_json
from hno.data.ties import APART, HALVINGS, TIE, tie_states
from hno.games import Game
from hno.pontryagin.mesh import label_times
from hno.pontryagin.solve import Solver, solve
from hno.pontryagin.threads import cores, label_pool
from hno.types import Status, best_of, of_starts

SOLVER_VERSION = 2
"""Counted up when the solver's results change, which makes cached labels stale."""


MORE = 16
"""Start states by whose multiples a search for safe ones grows."""


class Request(NamedTuple):
    """A set of labels: `starts` start states of one type, drawn by `seed`."""

    theta: tuple[float, ...]
    """Player types."""
    starts: int
    """Number of start states."""
    seed: int
    """Seed of the start states."""
    split: str
    """What the states are for, "train", "validation" or "test": different splits never share states."""
    widen: float = 1.0
    """Width of the start box in units of the game's."""
    symmetric: bool = False
    """Whether all players start in the same own state, that of the first player."""
    ties: bool = False
    """Whether the two cheapest equilibria of every start cost nearly the same, see `hno.data.ties`."""
    all_equilibria: bool = False
    """Whether every equilibrium that is found is a label, not only the cheapest of each start."""


class Progress(NamedTuple):
    """How far a generation is."""

    done: int
    """States solved in this run, failed ones included."""
    total: int
    """States to solve in this run."""
    converged: int
    """Converged ones among those that are done."""


Report = Callable[[Progress], None]
"""Called before the first label is solved, and when labels have been written."""


def default_cache() -> Path:
    """$HNO_CACHE, or the user's cache folder."""
    fallback = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hno"
    return Path(os.environ.get("HNO_CACHE") or fallback)


def start_states(game: Game, request: Request) -> Tensor:
    """Random start states of a request, float64, (starts, P, n); more of them begin with the fewer.

    They are uniform, but for ties, which are solved for.

    Raises:
        ValueError: symmetric ones of a game whose players are not interchangeable, or more ties than are found.
    """
    if request.symmetric and not interchangeable(game):
        raise ValueError(f"Symmetric starts need players of one role; {type(game).__name__} has roles {game.roles}.")
    text = canonical_json({"seed": request.seed, "split": request.split, "theta": [float(t) for t in request.theta]})
    seed, box = int(hashlib.sha256(text.encode()).hexdigest()[:15], 16), game.initial_box.widened(request.widen)

    def draw(size: int) -> Tensor:
        drawn = box.cpu().float().sample(size, torch.Generator().manual_seed(seed)).double()
        return drawn[:, :1].expand_as(drawn).contiguous() if request.symmetric else drawn

    return tie_states(game, request.theta, request.starts, draw) if request.ties else draw(request.starts)


def interchangeable(game: Game) -> bool:
    """Whether all players have the same role, without which no start is symmetric."""
    return len(set(game.roles)) == 1


def label_set(game: Game, request: Request, cache: Path, settings: Solver = Solver()) -> LabelSet:
    """Where a request's labels are; the folder's name holds a hash of everything that determines them."""
    content = provenance(game, request, settings)
    key = hashlib.sha256(canonical_json(content).encode()).hexdigest()[:16]
    types = "-".join(f"{t:g}" for t in request.theta)
    return LabelSet(cache / type(game).__name__ / f"{types}_{request.split}{request.seed}_{key}", content)


def provenance(game: Game, request: Request, settings: Solver) -> dict[str, Any]:
    """Everything that determines labels, but for how many there are: row k of a set is always the same."""
    content = request._replace(theta=tuple(map(float, request.theta)))._asdict()
    del content["starts"]
    if request.ties:
        content["ties"] = [TIE, APART, HALVINGS]
    for name in ("symmetric", "ties", "all_equilibria"):  # keeps the keys of sets that are older than these
        if not content[name]:
            del content[name]
    return {
        "game": type(game).__name__,
        "constants": _changed_constants(game),
        "fingerprint": game.fingerprint(),
        "request": content,
        "solver": _plain(settings),
        "solver_version": SOLVER_VERSION,
    }


def _changed_constants(game: Game) -> dict[str, Any]:
    """Constants that differ from the game's defaults, in full precision, which fingerprints do not have."""
    defaults = inspect.signature(type(game)).parameters
    changed = {name: value for name, value in game.constants.items() if value != defaults[name].default}
    return {name: list(map(float, v)) if isinstance(v, Sequence) else float(v) for name, v in changed.items()}


def _plain(content: Any) -> Any:
    if hasattr(content, "_asdict"):
        return {name: _plain(value) for name, value in content._asdict().items()}
    return [_plain(part) for part in content] if isinstance(content, (tuple, list)) else content


def labels_for(
    game: Game,
    requests: Sequence[Request],
    cache: Path,
    settings: Solver = Solver(),
    workers: int | None = None,
    report: Report | None = None,
) -> tuple[StoredLabels, float]:
    """Labels of every request, read from the cache or solved and written to it, shard by shard.

    Args:
        game: the game.
        requests: what is needed.
        cache: folder of label sets.
        settings: solver settings, part of the cache key.
        workers: processes with one thread each; as many as the job has cores by default.
        report: called before the first and as labels are written.

    Returns:
        One `Extremal` per request, failed rows included, read when it is asked for; the seconds spent on solving.

    Raises:
        LabelFileError: a cached file is damaged, and the cache cannot be written to; elsewhere it is moved aside.
        OSError: the cache cannot be written to, or what is missing does not fit there.
    """
    began = time.perf_counter()
    sets = [label_set(game, request, cache, settings) for request in requests]
    jobs = [job for labels, request in zip(sets, requests, strict=True) for job in _jobs(game, labels, request)]
    total, done, converged = sum(len(job.x0) - job.have for job in jobs), 0, 0
    if jobs:
        check_room(cache, label_bytes(game, total), f"Labels of {total} start states", "choose another with $HNO_CACHE")
    if jobs and report is not None:
        report(Progress(0, total, 0))
    with closing(_run(game, jobs, settings, workers)) as solved:  # whatever ends this ends the workers
        for status in solved:
            done += len(status)
            converged += int((status == Status.CONVERGED).sum())
            if report is not None:
                report(Progress(done, total, converged))
    for labels in sets:
        labels.write_manifest()
    return StoredLabels(sets, [request.starts for request in requests]), time.perf_counter() - began


def label_bytes(game: Game, starts: int) -> int:
    """Size of the labels of so many start states, if each has one equilibrium."""
    players, nodes = game.players, len(label_times(game, dtype=torch.float64, device=torch.device("cpu")))
    node = players * (1 + players) * game.state_dim + players * game.control_dim + players + 1
    return 8 * starts * nodes * node


def safe_labels_for(
    game: Game,
    requests: Sequence[Request],
    cache: Path,
    workers: int | None = None,
    report: Report | None = None,
    most: int = 4096,
    clearance: float = CLEARANCE,
) -> tuple[StoredLabels, float]:
    """Labels of as many start states as it takes until `starts` of each request are safe.

    Args:
        game: the game.
        requests: what is needed; `starts` counts safe ones.
        cache: folder of label sets.
        workers: see `labels_for`.
        report: called before the first and as labels are written, of every enlargement of the sets anew.
        most: start states of a type after which the search for safe ones ends.
        clearance: what the equilibrium of a safe start keeps, m for distance constraints.

    Returns:
        One `Extremal` per request, whose last row is the last safe start that was asked for, and the seconds spent.
    """
    wanted = [request.starts for request in requests]
    sizes, seconds = list(wanted), 0.0
    while True:
        asked = [request._replace(starts=size) for request, size in zip(requests, sizes, strict=True)]
        found, spent = labels_for(game, asked, cache, workers=workers, report=report)
        seconds += spent
        masks = [safe(labels, clearance) for labels in found]
        grown = [_enough(*entry, most) for entry in zip(masks, wanted, strict=True)]
        if grown == sizes:
            return StoredLabels(found.sets, list(map(_last, masks, wanted))), seconds
        sizes = grown


def _enough(mask: Tensor, wanted: int, most: int) -> int:
    """How many start states promise `wanted` safe ones, from the share of those that are known."""
    have = int(mask.sum())
    if have >= wanted:
        return len(mask)
    share = (have + 1) / (len(mask) + 1)
    return max(len(mask), min(most, len(mask) + MORE * math.ceil((wanted - have) / share / MORE)))


def _last(mask: Tensor, wanted: int) -> int:
    """Number of rows up to the last safe one that is wanted; all where there are fewer."""
    places = mask.nonzero().squeeze(-1)
    return int(places[wanted - 1]) + 1 if len(places) >= wanted else len(mask)


class _Job(NamedTuple):
    labels: LabelSet
    shard: int
    """Number of the shard."""
    x0: Tensor
    """Start states of the whole shard, as far as it is asked for."""
    have: int
    """Start states that the shard has already."""
    theta: tuple[float, ...]
    all_equilibria: bool


def _jobs(game: Game, labels: LabelSet, request: Request) -> Iterator[_Job]:
    """What a set lacks of a request; what it has is verified, but for where ties begin, which is solved for."""
    shards = range((request.starts - 1) // SHARD + 1)
    known = [None for _ in shards] if request.ties else start_states(game, request).split(SHARD)
    have = [labels.sound(shard, game, x0) for shard, x0 in zip(shards, known, strict=True)]
    if sum(have) >= request.starts and all(count == SHARD for count in have[:-1]):
        return
    labels.check_writable()
    for shard, (x0, count) in enumerate(zip(start_states(game, request).split(SHARD), have, strict=False)):
        if count < len(x0):
            yield _Job(labels, shard, x0, count, request.theta, request.all_equilibria)


def _run(game: Game, jobs: Sequence[_Job], settings: Solver, workers: int | None) -> Generator[Tensor, None, None]:
    """The status of every row that was missing, shard by shard; those that other processes solve are waited for."""
    left, waiting = dict(enumerate(jobs)), Waiting()
    while left:
        free = {number: job for number, job in left.items() if not _taken(job)}
        for number, status in _solved(game, free, settings, workers):
            if status is not None:
                del left[number]
                yield status
                waiting = Waiting()
        if left:
            waiting.announce(next(job.labels.claim_path(job.shard) for job in left.values()))
            time.sleep(POLL)


def _taken(job: _Job) -> bool:
    """Whether another process is solving a shard."""
    with job.labels.claim(job.shard) as ours:
        return not ours


def _solved(
    game: Game, jobs: Mapping[int, _Job], settings: Solver, workers: int | None
) -> Iterator[tuple[int, Tensor | None]]:
    """What `_solve_shard` answers for each job."""
    workers = min(workers or cores(), len(jobs))
    if workers <= 1:
        return ((number, _solve_shard(game, job, settings)) for number, job in jobs.items())
    pool = label_pool(workers, "generator_unordered")
    return pool(joblib.delayed(_solve_alone)(number, game, job, settings) for number, job in jobs.items())


def _solve_alone(number: int, game: Game, job: _Job, settings: Solver) -> tuple[int, Tensor | None]:
    torch.set_num_threads(1)
    return number, _solve_shard(game, job, settings)


def _solve_shard(game: Game, job: _Job, settings: Solver) -> Tensor | None:
    """Solve the start states that a shard lacks and write it; another process may have done so meanwhile.

    Returns:
        The status of the best extremal of each of them; None where another process is solving them.
    """
    with job.labels.claim(job.shard) as ours:
        if not ours:
            return None
        have = job.labels.starts(job.shard)
        x0 = job.x0[have:]
        if len(x0) > 0:
            theta = torch.tensor(job.theta, dtype=torch.float64).expand(len(x0), -1)
            job.labels.append(job.shard, have, solve(game, x0, theta, settings, all_equilibria=job.all_equilibria))
    return best_of(of_starts(job.labels.read_shard(job.shard), job.have, len(job.x0))).status
