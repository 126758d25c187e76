"""The game solved again while it is played: equilibria of what remains of it, warm-started from the last ones."""

from __future__ import annotations

import copy
from typing import NamedTuple

import torch
from torch import Tensor

from hno.games import Game
from hno.pontryagin.collocation import Collocation, Iterate
from hno.pontryagin.mesh import encounter_weight, graded_mesh, inner_times, label_times
from hno.pontryagin.newton import newton, rescue
from hno.pontryagin.saturation import lengthened
from hno.pontryagin.solve import OnMesh, Solver, solve_on_mesh
from hno.types import Status


class Plan(NamedTuple):
    """Open-loop equilibria from now to the end of a game, and how they were found."""

    at: Iterate
    """States and own costates over the time to go, one mesh per row."""
    searched: Tensor
    """Rows for which several starts were searched, bool, (B,)."""
    failed: Tensor
    """Rows that were not solved, bool, (B,): they keep the rest of their last plan, or the best attempt if it is the
    first."""


def subgame(game: Game, tau: float) -> Game:
    """What remains of a game with time to go `tau`, s: a copy in float64 with that horizon.

    Games do not depend on time, so `solve(subgame(game, tau), x, theta)` solves them from any time on.

    Raises:
        ValueError: `tau` is not positive, or longer than the game.
    """
    if not 0 < tau <= game.horizon * (1 + 1e-6):
        raise ValueError(
            f"The time to go must be positive and at most the horizon of {game.horizon:g} s; got {tau:g} s."
        )
    rest = copy.deepcopy(game).double()
    rest.horizon = tau
    return rest


def first_plan(game: Game, x: Tensor, theta: Tensor, settings: Solver = Solver()) -> Plan:
    """Solve from nothing but states (B, P, n) and types (B, P), float64, by the search of `hno.solve`."""
    found = solve_on_mesh(game, x, theta, settings)
    return Plan(found.at, torch.ones_like(found.status, dtype=torch.bool), found.status != Status.CONVERGED)


def replan(game: Game, x: Tensor, last: Iterate, settings: Solver = Solver()) -> Plan:
    """Solve from where the players are now; Newton starts from what remains of their last plan.

    Rows that Newton does not solve are searched as in `first_plan`; those that
    are still not solved keep their last plan.

    Args:
        game: the rest of the game, from `subgame`.
        x: states now, (B, P, n), float64.
        last: the last plan; it ends when the game does.
        settings: solver settings.
    """
    with torch.no_grad():
        rest = remaining(game, last, settings.extra_nodes)
        start = rest._replace(z=_starting_at(x, rest.z))
        equations = Collocation(game)
        found = newton(equations, start, settings.newton)
        found = rescue(equations, start, found, torch.arange(len(x), device=x.device), settings.newton)
        failed = found.status != Status.CONVERGED
        at, lost = rest._replace(z=rest.z.where(failed[:, None, None], found.z)), failed.nonzero().squeeze(-1)
        if len(lost) == 0:
            return Plan(at, failed, failed)
        fresh = solve_on_mesh(game, x[lost], last.theta[lost], settings)
        return Plan(_merged(at, fresh, lost), failed, failed.index_put((lost,), fresh.status != Status.CONVERGED))


def remaining(game: Game, last: Iterate, extra: int) -> Iterate:
    """What remains of a plan, on a mesh that is graded anew for the time to go."""
    equations, labels = Collocation(game), label_times(game, dtype=last.t.dtype, device=last.t.device)
    inner = inner_times(labels)
    x = equations.split(_ahead(game, last, inner.flatten()))[0].unflatten(1, inner.shape)
    cost = game.uncontrolled_cost(x, last.theta[:, None, None].expand(x.shape[:-1]))
    t = graded_mesh(labels, encounter_weight(cost), extra)
    return Iterate(t, _ahead(game, last, t), last.theta)


def planned_control(game: Game, plan: Iterate) -> Tensor:
    """Controls that a plan has for the first moment of the rest of a game, (B, P, m)."""
    with torch.no_grad():
        return game.best_response(*Collocation(game).split(_ahead(game, plan, plan.t.new_zeros(1))[:, 0]))


def _ahead(game: Game, plan: Iterate, t: Tensor) -> Tensor:
    """Unknowns of a plan at times of the rest of the game, (M,) or (B, M), kept in its span against rounding."""
    passed = plan.t[:, -1:] - game.horizon
    return Collocation(game).at_times(plan, (passed + t).clamp_min(0).minimum(plan.t[:, -1:]))


def _starting_at(x: Tensor, z: Tensor) -> Tensor:
    """Unknowns (B, K, D) with the first states replaced by x (B, P, n)."""
    states = x.flatten(-2)
    return torch.cat([torch.cat([states, z[:, 0, states.shape[-1] :]], -1).unsqueeze(1), z[:, 1:]], 1)


def _merged(at: Iterate, fresh: OnMesh, rows: Tensor) -> Iterate:
    """Trajectories with the rows that a search has solved put in; meshes are filled up with intervals of length 0."""
    done = fresh.status == Status.CONVERGED
    length = max(at.t.shape[1], fresh.at.t.shape[1])
    t, z = lengthened(at.t, length), lengthened(at.z, length)
    t[rows[done]], z[rows[done]] = lengthened(fresh.at.t, length)[done], lengthened(fresh.at.z, length)[done]
    return at._replace(t=t, z=z)
