"""Costates and values along a known trajectory, by one backward sweep.

Given states and controls, the adjoint equations are linear; the same Lobatto IIIA formula as in the collocation keeps
the order.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hno.games import Game
from hno.games.potential import Team
from hno.pontryagin.adjoint import cost_gradient, dynamics_jacobian, terminal_costate


def costates(game: Game, t: Tensor, x: Tensor, u: Tensor, middle: tuple[Tensor, Tensor], theta: Tensor) -> Tensor:
    """Every dV_i / dx_j along a trajectory, (B, K, P, P, n).

    Args:
        game: the game, float64.
        t: times, s, (B, K).
        x: states, (B, K, P, n).
        u: controls, (B, K, P, m).
        middle: states and controls at the interval centres, (B, K - 1, P, n) and (B, K - 1, P, m).
        theta: player types, (B, P).
    """
    matrix, load = _adjoint_terms(game, x, u, theta)
    middle_matrix, middle_load = _adjoint_terms(game, *middle, theta)
    h = t.diff(dim=-1)[..., None, None, None]
    eye = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
    before, after = matrix[:, :-1], matrix[:, 1:]
    # rate = load - matrix' l at both ends and, with the Hermite value of l, at the centre
    left = eye - h / 6 * (before + middle_matrix @ (2 * eye - h / 2 * before))
    right = eye + h / 6 * (after + middle_matrix @ (2 * eye + h / 2 * after))
    h = h[..., 0].unsqueeze(-1)
    bend = (middle_matrix.unsqueeze(-4) @ (h / 8 * (load[:, :-1] - load[:, 1:])).unsqueeze(-1)).squeeze(-1)
    known = -h[..., 0].unsqueeze(-1) / 6 * (load[:, :-1] + 4 * (middle_load - bend) + load[:, 1:])
    costate = [terminal_costate(game, x[:, -1])]
    for k in reversed(range(t.shape[-1] - 1)):
        carried = torch.einsum("bjac,bijc->bija", right[:, k], costate[-1]) + known[:, k]
        solved = torch.linalg.solve_ex(left[:, k].unsqueeze(1), carried.unsqueeze(-1)).result
        costate.append(solved.squeeze(-1))
    return torch.stack(costate[::-1], 1)


def _adjoint_terms(game: Game, x: Tensor, u: Tensor, theta: Tensor) -> tuple[Tensor, Tensor]:
    """A = (df_j/dx_j)' (B, K, P, n, n) and q = d cost_i / dx_j (B, K, P, P, n) of the rate q - A l."""
    types = theta.unsqueeze(-2).expand(x.shape[:-1])
    return dynamics_jacobian(game, x, u).mT, cost_gradient(game, x, types)


def values(
    problem: Game | Team, t: Tensor, x: Tensor, u: Tensor, middle: tuple[Tensor, Tensor], theta: Tensor
) -> Tensor:
    """V_i, or W of a team, from each node to the end by Simpson's rule, (B, K, Q). Arguments as for `costates`."""
    types = theta.unsqueeze(-2)
    cost = problem.running_cost(x, u, types.expand(x.shape[:-1]))
    centre = problem.running_cost(*middle, types.expand(middle[0].shape[:-1]))
    spent = t.diff(dim=-1).unsqueeze(-1) / 6 * (cost[:, :-1] + 4 * centre + cost[:, 1:])
    to_go = spent.flip(1).cumsum(1).flip(1)
    return problem.terminal_value(x[:, -1]).unsqueeze(1) - torch.nn.functional.pad(to_go, (0, 0, 0, 1))
