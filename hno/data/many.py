"""Equilibria from many start states of any types, solved in processes and not kept."""

from __future__ import annotations

import copy

import joblib
from torch import Tensor

from hno.data.labels import Progress, Report
from hno.games import Game
from hno.pontryagin.solve import Solver, solve
from hno.pontryagin.threads import cores, label_pool
from hno.types import Extremal, Status, best_of, join

CHUNK = 64
"""Start states that one process solves at a time."""


def solve_many(
    game: Game,
    x0: Tensor,
    theta: Tensor,
    settings: Solver = Solver(),
    workers: int | None = None,
    report: Report | None = None,
    *,
    all_equilibria: bool = False,
) -> Extremal:
    """The equilibria from start states, in their order.

    Args:
        game: the game.
        x0: start states, (B, P, n), at least one.
        theta: types, (B, P).
        settings: of the solver.
        workers: processes with one thread each; as many as the job has cores by default.
        report: called as start states are solved.
        all_equilibria: as of `solve`.
    """
    game = copy.deepcopy(game).cpu()
    jobs = enumerate(zip(x0.cpu().double().split(CHUNK), theta.cpu().double().split(CHUNK), strict=True))
    pool = label_pool(min(workers or cores(), -(-len(x0) // CHUNK)), "generator_unordered")
    call, found, done, converged = joblib.delayed(_numbered), dict[int, Extremal](), 0, 0
    for number, some in pool(call(number, game, *job, settings, all_equilibria) for number, job in jobs):
        found[number], best = some, best_of(some).status
        done, converged = done + len(best), converged + int((best == Status.CONVERGED).sum())
        if report is not None:
            report(Progress(done, len(x0), converged))
    return join([found[number] for number in sorted(found)])


def _numbered(
    number: int, game: Game, x0: Tensor, theta: Tensor, settings: Solver, every: bool
) -> tuple[int, Extremal]:
    return number, solve(game, x0, theta, settings, all_equilibria=every)
