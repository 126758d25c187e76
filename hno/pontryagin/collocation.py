"""Batched Newton on Hermite-Simpson (Lobatto IIIA) collocation of Pontryagin's conditions.

Unknowns are the states and own costates, D = 2 P n per node. Trajectories are independent rows of a batch: each has its
own mesh, step length and stopping test.
"""

from __future__ import annotations

import copy
from typing import NamedTuple

import torch
from torch import Tensor

from hno.games import Game
from hno.games.base import own_costate
from hno.pontryagin.adjoint import jacobian_rows, pmp_rate, pmp_rate_and_jacobian, terminal_costate
from hno.types import Status

BLOCK = 1024
"""Points that are differentiated together: few enough for the processor's cache."""


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


class Iterate(NamedTuple):
    """A batch of discrete trajectories, z = (x, own costate) flattened."""

    t: Tensor
    """Times, s, (B, K)."""
    z: Tensor
    """Unknowns, (B, K, D)."""
    theta: Tensor
    """Player types, (B, P)."""

    def rows(self, index: Tensor) -> Iterate:
        """The trajectories at `index`."""
        return Iterate(self.t[index], self.z[index], self.theta[index])


class Collocation:
    """The collocation equations of one game.

    Args:
        game: the game, float64.
    """

    def __init__(self, game: Game) -> None:
        self.game = game
        self.half = game.players * game.state_dim

    def rate(self, z: Tensor, theta: Tensor) -> Tensor:
        """dz/dt, (B, K, D)."""
        x, own = self.split(z)
        rates = pmp_rate(self.game, x, own, theta.unsqueeze(-2).expand(x.shape[:-1]))
        return torch.cat([r.flatten(-2) for r in rates], -1)

    def rate_and_jacobian(self, z: Tensor, theta: Tensor) -> tuple[Tensor, Tensor]:
        """dz/dt and its derivative in z, (B, K, D) and (B, K, D, D)."""
        x, own = self.split(z)
        types = theta.unsqueeze(-2).expand(x.shape[:-1])
        rate, jacobian = pmp_rate_and_jacobian(self.game, *(part.flatten(0, 1) for part in (x, own, types)))
        return rate.unflatten(0, z.shape[:2]), jacobian.unflatten(0, z.shape[:2])

    def split(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """States and own costates of the unknowns, each (..., P, n)."""
        x, own = z.unflatten(-1, (2, self.game.players, self.game.state_dim)).unbind(-3)
        return x, own

    def midpoint(self, z: Tensor, rate: Tensor, step: Tensor) -> Tensor:
        """Hermite interpolant at interval centres, (B, K - 1, D)."""
        bend = step.unsqueeze(-1) / 8 * (rate[:, :-1] - rate[:, 1:])
        return (z[:, :-1] + z[:, 1:]) / 2 + bend

    def interpolate(self, at: Iterate, share: Tensor) -> Tensor:
        """The cubic Hermite interpolant at shares (S,) of every interval, (B, K - 1, S, D)."""
        rate = self.rate(at.z, at.theta)
        ends = Ends(at.z[:, :-1, None], at.z[:, 1:, None], rate[:, :-1, None], rate[:, 1:, None])
        return hermite(ends, at.t.diff(dim=-1)[..., None, None], share.unsqueeze(-1))

    def at_times(self, at: Iterate, t: Tensor) -> Tensor:
        """The same interpolant at times (B, M) of the mesh's span, (B, M, D)."""
        left = (torch.searchsorted(at.t.contiguous(), t.contiguous()) - 1).clamp_min(0)
        rows = torch.arange(len(t), device=t.device).unsqueeze(-1)
        rate = self.rate(at.z, at.theta)
        ends = Ends(at.z[rows, left], at.z[rows, left + 1], rate[rows, left], rate[rows, left + 1])
        step = at.t[rows, left + 1] - at.t[rows, left]
        return hermite(ends, step.unsqueeze(-1), ((t - at.t[rows, left]) / step).unsqueeze(-1))

    def defect(self, at: Iterate) -> Tensor:
        """Simpson defect of each interval, (B, K - 1, D)."""
        step = at.t.diff(dim=-1)
        rate = self.rate(at.z, at.theta)
        middle = self.rate(self.midpoint(at.z, rate, step), at.theta)
        return at.z.diff(dim=-2) - step.unsqueeze(-1) / 6 * (rate[:, :-1] + 4 * middle + rate[:, 1:])

    def terminal_defect(self, at: Iterate) -> Tensor:
        """Own costates minus those of the terminal value, (B, D / 2)."""
        x, own = at.z[:, -1].split(self.half, -1)
        target = terminal_costate(self.game, x.unflatten(-1, (self.game.players, -1)))
        return own - own_costate(target).flatten(-2)

    def residual(self, at: Iterate) -> Tensor:
        """Largest defect of each trajectory, relative to the size of its component, (B,)."""
        scale = self.scale(at.z)
        defect = (self.defect(at) / scale).abs().amax((-2, -1))
        terminal = (self.terminal_defect(at) / scale[:, 0, self.half :]).abs().amax(-1)
        return torch.maximum(defect, terminal).nan_to_num(nan=torch.inf)

    def scale(self, z: Tensor) -> Tensor:
        """Size of each component: box widths for states, largest values (at least 1) for costates, (B, 1, D)."""
        width = self.game.state_box.width.flatten().expand(len(z), 1, -1)
        return torch.cat([width, z[..., self.half :].abs().amax(-2, keepdim=True).clamp_min(1)], -1)

    def linearise(self, at: Iterate) -> Elimination:
        """The equations linearised around an iterate and factorised, in the precision of the game."""
        at = Iterate(*(part.to(self.game.state_box.lo.dtype) for part in at))
        blocks = torch.arange(len(at.z), device=at.z.device).split(max(1, BLOCK // at.z.shape[1]))
        left, right = zip(*(self._derivatives(at.rows(index)) for index in blocks), strict=True)
        return eliminate(torch.cat(left), torch.cat(right), self._terminal_slope(at))

    def _derivatives(self, at: Iterate) -> tuple[Tensor, Tensor]:
        """Derivatives of each interval's defect in the unknowns at its two ends, (B, K - 1, D, D)."""
        size = at.t.diff(dim=-1)
        h = size[..., None, None] / 6
        rate, jacobian = self.rate_and_jacobian(at.z, at.theta)
        middle = h * self.rate_and_jacobian(self.midpoint(at.z, rate, size), at.theta)[1]
        before, after = h * jacobian[:, :-1], h * jacobian[:, 1:]
        eye = torch.eye(2 * self.half, dtype=at.z.dtype, device=at.z.device)
        left = -eye - before - 2 * middle - 3 * middle @ before
        return left, eye - after - 2 * middle + 3 * middle @ after

    def _terminal_slope(self, at: Iterate) -> Tensor:
        """Derivative of the terminal own costates in the terminal states, (B, D / 2, D / 2)."""
        with torch.enable_grad():
            flat = at.z[:, -1, : self.half].detach().requires_grad_()
            target = terminal_costate(self.game, flat.unflatten(-1, (self.game.players, -1)), create_graph=True)
            return jacobian_rows(own_costate(target).flatten(-2), flat).movedim(0, -2)


class Ends(NamedTuple):
    """Unknowns and their rates at both ends of a step, tensors of one shape."""

    before: Tensor
    after: Tensor
    rate_before: Tensor
    rate_after: Tensor


def hermite(ends: Ends, step: Tensor, share: Tensor) -> Tensor:
    """The cubic with given values and rates at both ends of a step, at a share of it."""
    chord = ends.before + (3 - 2 * share) * share**2 * (ends.after - ends.before)
    return chord + step * share * (1 - share) * ((1 - share) * ends.rate_before - share * ends.rate_after)


class Elimination(NamedTuple):
    """Block elimination of left_k dz_k + right_k dz_{k+1} = -defect_k with dl_K = slope dx_K - terminal defect.

    Backward, the step of the costates is kept as an affine function of the step of the states, dl_k = S_k dx_k + s_k;
    forward, the states follow. Initial states are fixed, so dx_0 = 0.
    """

    factors: Tensor
    """LU factors of each interval's matrix for (dl_k, dx_{k+1}), (B, K - 1, D, D)."""
    pivots: Tensor
    """Pivots of the factors, (B, K - 1, D)."""
    slopes: Tensor
    """(dl_k, dx_{k+1}) per dx_k, (B, K - 1, D, D / 2)."""
    ahead: Tensor
    """Derivative of each defect in the next costates, (B, K - 1, D, D / 2)."""
    end: Tensor
    """S_K, (B, D / 2, D / 2)."""

    def rows(self, index: Tensor) -> Elimination:
        """The systems at `index`."""
        return Elimination(*(part[index] for part in self))

    def solve(self, defect: Tensor, terminal_defect: Tensor) -> Tensor:
        """Step that removes the defects (B, K - 1, D) and (B, D / 2) to first order, (B, K, D)."""
        half = self.end.shape[-1]
        defect, shift = defect.to(self.end.dtype), -terminal_defect.to(self.end.dtype)
        offsets = []
        for k in reversed(range(defect.shape[1])):
            known = defect[:, k] + _apply(self.ahead[:, k], shift)
            offsets.append(
                -torch.linalg.lu_solve(self.factors[:, k], self.pivots[:, k], known.unsqueeze(-1)).squeeze(-1)
            )
            shift = offsets[-1][:, :half]
        end, state, step = -terminal_defect.to(self.end.dtype), torch.zeros_like(shift), []
        for k, offset in enumerate(reversed(offsets)):
            costate, following = (_apply(self.slopes[:, k], state) + offset).split(half, -1)
            step.append(torch.cat([state, costate], -1))
            state = following
        step.append(torch.cat([state, _apply(self.end, state) + end], -1))
        return torch.stack(step, 1)


def eliminate(left: Tensor, right: Tensor, end: Tensor) -> Elimination:
    """Factorise, from the last interval to the first; arguments as in `Elimination`."""
    half, slope = end.shape[-1], end
    factors, pivots, slopes = [], [], []
    for k in reversed(range(left.shape[1])):
        matrix = torch.cat([left[:, k, :, half:], right[:, k, :, :half] + right[:, k, :, half:] @ slope], -1)
        factor, pivot, _ = torch.linalg.lu_factor_ex(matrix)
        slopes.append(-torch.linalg.lu_solve(factor, pivot, left[:, k, :, :half]))
        factors.append(factor)
        pivots.append(pivot)
        slope = slopes[-1][:, :half]
    stacked = [torch.stack(part[::-1], 1) for part in (factors, pivots, slopes)]
    return Elimination(stacked[0], stacked[1], stacked[2], right[..., half:].contiguous(), end)


def _apply(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


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
