"""Hermite-Simpson (Lobatto IIIA) collocation of Pontryagin's conditions.

Unknowns are the states and own costates, D = 2 P n per node. Trajectories are independent rows of a batch: each has its
own mesh.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from hno.games import Game
from hno.games.base import own_costate
from hno.pontryagin.adjoint import jacobian_rows, pmp_rate, pmp_rate_and_jacobian, terminal_costate
from hno.pontryagin.elimination import Elimination, eliminate

BLOCK = 1024
"""Points that are differentiated together: few enough for the processor's cache."""


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
