"""Batched Newton on the collocation equations; every trajectory has its own step length and stopping test."""

from __future__ import annotations

import copy
from typing import NamedTuple

import torch
from torch import Tensor

from hno.pontryagin.collocation import Collocation, Iterate
from hno.pontryagin.elimination import Elimination
from hno.types import Status


class Newton(NamedTuple):
    """When Newton stops."""

    tolerance: float = 1e-10
    """Largest scaled residual of a converged trajectory."""
    steps: int = 40
    """Step budget."""
    reuses: int = 6
    """Further steps with the derivatives of one step, while they cut the residual to a fifth."""
    halvings: int = 8
    """Step-length halvings before the search counts as stalled."""
    full_steps: int = 20
    """Budget of undamped steps for a stalled trajectory, from each of two origins."""


class Solved(NamedTuple):
    """Where Newton ended."""

    z: Tensor
    """Unknowns, (B, K, D)."""
    residual: Tensor
    """Largest scaled residuals, (B,)."""
    status: Tensor
    """`Status`, (B,)."""


def newton(equations: Collocation, start: Iterate, settings: Newton) -> Solved:
    """Damped Newton; every trajectory stops on its own.

    Derivatives are taken in single precision: it is the defect that must be exact.
    """
    rough = Collocation(copy.deepcopy(equations.game).float())
    return _damped_steps(equations, rough, start, settings)


def rescue(equations: Collocation, start: Iterate, found: Solved, rows: Tensor, settings: Newton) -> Solved:
    """Full steps for stalled trajectories, in double precision: first from where they stalled, then from the start.

    Where controls reach their bounds the equations have kinks. There a residual that must fall at every step stops the
    search, but full steps carry it through.

    Args:
        equations: the equations.
        start: where Newton started.
        found: where it ended.
        rows: trajectories to rescue, (R,).
        settings: the budget.
    """
    z, residual, status = (part.clone() for part in found)
    for origin in (found.z, start.z):
        rows = rows[status[rows] == Status.STALLED]
        if len(rows) == 0:
            break
        reached, size = _full_steps(equations, Iterate(start.t[rows], origin[rows], start.theta[rows]), settings)
        done = size <= settings.tolerance
        z[rows[done]], residual[rows[done]], status[rows[done]] = reached[done], size[done], Status.CONVERGED
    return Solved(z, residual, status)


def _full_steps(equations: Collocation, at: Iterate, settings: Newton) -> tuple[Tensor, Tensor]:
    """Unknowns and residuals of undamped Newton, when converged or after the last step."""
    z, residual = at.z.clone(), torch.full_like(at.z[:, 0, 0], torch.inf)
    for _ in range(settings.full_steps):
        active = (residual > settings.tolerance).nonzero().squeeze(-1)
        if len(active) == 0:
            break
        part = Iterate(at.t[active], z[active], at.theta[active])
        z[active] += _direction(equations, equations.linearise(part), part)
        residual[active] = equations.residual(part._replace(z=z[active]))
    return z, residual


def _direction(equations: Collocation, system: Elimination, at: Iterate) -> Tensor:
    return system.solve(equations.defect(at), equations.terminal_defect(at)).to(at.z.dtype).nan_to_num(0, 0, 0)


def _damped_steps(equations: Collocation, rough: Collocation, start: Iterate, settings: Newton) -> Solved:
    """Newton with a line search."""
    z, residual = start.z.clone(), equations.residual(start)
    status = torch.full_like(residual, Status.MAX_STEPS, dtype=torch.int64)
    for _ in range(settings.steps):
        status[residual <= settings.tolerance] = Status.CONVERGED
        active = (status == Status.MAX_STEPS).nonzero().squeeze(-1)
        if len(active) == 0:
            break
        at = Iterate(start.t[active], z[active], start.theta[active])
        system = rough.linearise(at)
        moved, reached = _line_search(equations, system, at, residual[active], settings.halvings)
        stuck = reached >= residual[active]
        status[active[stuck]] = Status.STALLED
        status[active[~reached.isfinite()]] = Status.NOT_FINITE
        _reuse(equations, system, at._replace(z=moved), reached, (~stuck).nonzero().squeeze(-1), settings)
        z[active[~stuck]], residual[active[~stuck]] = moved[~stuck], reached[~stuck]
    status[residual <= settings.tolerance] = Status.CONVERGED
    return Solved(z, residual, status)


def _line_search(
    equations: Collocation, system: Elimination, at: Iterate, residual: Tensor, halvings: int
) -> tuple[Tensor, Tensor]:
    """The longest of the halved Newton steps that lowers the residual, and the residual there."""
    direction = _direction(equations, system, at)
    best, reached = at.z.clone(), torch.full_like(residual, torch.inf)
    searching = torch.arange(len(residual), device=residual.device)
    for halving in range(halvings + 1):
        trial = at.rows(searching)._replace(z=at.z[searching] + 0.5**halving * direction[searching])
        value = equations.residual(trial)
        lower = value < reached[searching]
        best[searching[lower]], reached[searching[lower]] = trial.z[lower], value[lower]
        searching = searching[value >= (1 - 0.1 * 0.5**halving) * residual[searching]]
        if len(searching) == 0:
            break
    return best, reached


def _reuse(
    equations: Collocation, system: Elimination, at: Iterate, residual: Tensor, rows: Tensor, settings: Newton
) -> None:
    """Further steps with the same derivatives, in place, for as long as they cut the residual to a fifth.

    They are cheap, so they go on to a hundredth of the tolerance.
    """
    for _ in range(settings.reuses):
        rows = rows[residual[rows] > settings.tolerance / 100]
        if len(rows) == 0:
            break
        part = at.rows(rows)
        trial = part._replace(z=part.z + _direction(equations, system.rows(rows), part))
        value = equations.residual(trial)
        lower = value < residual[rows]
        good = value < 0.2 * residual[rows]
        at.z[rows[lower]], residual[rows[lower]] = trial.z[lower], value[lower]
        rows = rows[good]
