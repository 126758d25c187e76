"""Batched Newton on Hermite-Simpson (Lobatto IIIA) collocation of Pontryagin's conditions.

Unknowns are the states and own costates, D = 2 P n per node. Trajectories are independent rows of a batch: each has its
own mesh, step length and stopping test.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from hno.games import Game
from hno.games.base import own_costate
from hno.pontryagin.adjoint import jacobian_rows, pmp_rate, pmp_rate_and_jacobian, terminal_costate
from hno.types import Status

BLOCK = 512
"""Points that are differentiated together: few enough for the processor's cache."""


class Newton(NamedTuple):
    """When Newton stops."""

    tolerance: float = 1e-10
    """Largest scaled residual of a converged trajectory."""
    steps: int = 40
    """Step budget."""
    halvings: int = 8
    """Step-length halvings before the search counts as stalled."""
    full_steps: int = 25
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
        blocks = zip(*(part.flatten(0, 1).split(BLOCK) for part in (x, own, types)), strict=True)
        parts = zip(*(pmp_rate_and_jacobian(self.game, *block) for block in blocks), strict=True)
        rate, jacobian = (torch.cat(part).unflatten(0, z.shape[:2]) for part in parts)
        return rate, jacobian

    def split(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """States and own costates of the unknowns, each (..., P, n)."""
        x, own = z.unflatten(-1, (2, self.game.players, self.game.state_dim)).unbind(-3)
        return x, own

    def midpoint(self, z: Tensor, rate: Tensor, step: Tensor) -> Tensor:
        """Hermite interpolant at interval centres, (B, K - 1, D)."""
        bend = step.unsqueeze(-1) / 8 * (rate[:, :-1] - rate[:, 1:])
        return (z[:, :-1] + z[:, 1:]) / 2 + bend

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

    def step(self, at: Iterate) -> Tensor:
        """Newton step by block elimination, (B, K, D).

        Backward, the step of the costates is kept as an affine function of the step of the states,
        dl_k = S_k dx_k + s_k; forward, the states follow. Initial states are fixed, so dx_0 = 0.
        """
        size = at.t.diff(dim=-1)
        rate, jacobian = self.rate_and_jacobian(at.z, at.theta)
        middle, middle_jacobian = self.rate_and_jacobian(self.midpoint(at.z, rate, size), at.theta)
        h = size[..., None, None]
        defect = at.z.diff(dim=-2) - h[..., 0] / 6 * (rate[:, :-1] + 4 * middle + rate[:, 1:])
        eye = torch.eye(2 * self.half, dtype=at.z.dtype, device=at.z.device)
        left = jacobian[:, :-1] + middle_jacobian @ (2 * eye + h / 2 * jacobian[:, :-1])
        right = jacobian[:, 1:] + middle_jacobian @ (2 * eye - h / 2 * jacobian[:, 1:])
        return self._eliminate(-eye - h / 6 * left, eye - h / 6 * right, defect, *self._terminal(at))

    def _terminal(self, at: Iterate) -> tuple[Tensor, Tensor]:
        """S_K and s_K of the linearised terminal condition, (B, D/2, D/2) and (B, D/2)."""
        with torch.enable_grad():
            flat = at.z[:, -1, : self.half].detach().requires_grad_()
            target = terminal_costate(self.game, flat.unflatten(-1, (self.game.players, -1)), create_graph=True)
            hessian = jacobian_rows(own_costate(target).flatten(-2), flat).movedim(0, -2)
        return hessian, -self.terminal_defect(at)

    def _eliminate(self, left: Tensor, right: Tensor, defect: Tensor, slope: Tensor, shift: Tensor) -> Tensor:
        """Solve left_k dz_k + right_k dz_{k+1} = -defect_k with dl_K = slope dx_K + shift, (B, K, D)."""
        half, end = self.half, (slope, shift)
        affine: list[Tensor] = []  # (dl_k, dx_{k+1}) as a function of (dx_k, 1), from the last interval to the first
        for k in reversed(range(left.shape[1])):
            next_costate = right[:, k, :, half:]
            matrix = torch.cat([left[:, k, :, half:], right[:, k, :, :half] + next_costate @ slope], -1)
            known = defect[:, k].unsqueeze(-1) + next_costate @ shift.unsqueeze(-1)
            affine.append(-torch.linalg.solve_ex(matrix, torch.cat([left[:, k, :, :half], known], -1)).result)
            slope, shift = affine[-1][:, :half, :half], affine[-1][:, :half, half]
        state = torch.zeros_like(shift)
        step = []
        for row in reversed(affine):
            costate, following = _apply(row[..., :half], row[..., half], state).split(half, -1)
            step.append(torch.cat([state, costate], -1))
            state = following
        step.append(torch.cat([state, _apply(*end, state)], -1))
        return torch.stack(step, 1)


def _apply(matrix: Tensor, offset: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1) + offset


def newton(equations: Collocation, start: Iterate, settings: Newton) -> tuple[Tensor, Tensor, Tensor]:
    """Damped Newton, then full steps for what stalled; every trajectory stops on its own.

    Where controls reach their bounds the equations have kinks. There a residual that must fall at every step stops the
    search, but full steps carry it through: first from where it stalled, then from the start.

    Returns:
        The unknowns (B, K, D), their scaled residual (B,) and `Status` (B,).
    """
    z, residual, status = _damped_steps(equations, start, settings)
    for origin in (z.clone(), start.z):
        rows = (status == Status.STALLED).nonzero().squeeze(-1)
        if len(rows) == 0:
            break
        reached, size = _full_steps(equations, Iterate(start.t[rows], origin[rows], start.theta[rows]), settings)
        done = size <= settings.tolerance
        z[rows[done]], residual[rows[done]], status[rows[done]] = reached[done], size[done], Status.CONVERGED
    return z, residual, status


def _full_steps(equations: Collocation, at: Iterate, settings: Newton) -> tuple[Tensor, Tensor]:
    """Unknowns and residuals of undamped Newton, when converged or after the last step."""
    z, residual = at.z.clone(), torch.full_like(at.z[:, 0, 0], torch.inf)
    for _ in range(settings.full_steps):
        active = (residual > settings.tolerance).nonzero().squeeze(-1)
        if len(active) == 0:
            break
        part = Iterate(at.t[active], z[active], at.theta[active])
        z[active] += equations.step(part).nan_to_num(0, 0, 0)
        residual[active] = equations.residual(part._replace(z=z[active]))
    return z, residual


def _damped_steps(equations: Collocation, start: Iterate, settings: Newton) -> tuple[Tensor, Tensor, Tensor]:
    """Newton with a line search: unknowns, residuals and `Status`."""
    z, residual = start.z.clone(), equations.residual(start)
    status = torch.full_like(residual, Status.MAX_STEPS, dtype=torch.int64)
    for _ in range(settings.steps):
        status[residual <= settings.tolerance] = Status.CONVERGED
        active = (status == Status.MAX_STEPS).nonzero().squeeze(-1)
        if len(active) == 0:
            break
        at = Iterate(start.t[active], z[active], start.theta[active])
        moved, reached = _line_search(equations, at, residual[active], settings.halvings)
        stuck = reached >= residual[active]
        status[active[stuck]] = Status.STALLED
        status[active[~reached.isfinite()]] = Status.NOT_FINITE
        z[active[~stuck]], residual[active[~stuck]] = moved[~stuck], reached[~stuck]
    status[residual <= settings.tolerance] = Status.CONVERGED
    return z, residual, status


def _line_search(equations: Collocation, at: Iterate, residual: Tensor, halvings: int) -> tuple[Tensor, Tensor]:
    """The longest of the halved Newton steps that lowers the residual, and the residual there."""
    direction = equations.step(at).nan_to_num(0, 0, 0)
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
