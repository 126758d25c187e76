"""Pontryagin's conditions of any game, by autograd (paper, eq. 4).

The equilibrium is open-loop: adjoints differentiate the Hamiltonian at *fixed* controls.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hno.games import Game
from hno.games.base import own_costate


def per_player_copies(x: Tensor) -> Tensor:
    """One copy of the joint state for each player, (B, P, n) -> (B, P, P, n).

    The gradient of a sum over players with respect to the copies holds every d(.)_i / dx_j in one pass.
    """
    players = x.shape[-2]
    return x.unsqueeze(-3).expand(*x.shape[:-2], players, players, x.shape[-1])


def penalty_gradient(game: Game, x: Tensor, theta: Tensor, *, create_graph: bool = False) -> Tensor:
    """Gradient of every player's penalty in every player's state, (B, P, n) -> (B, P, P, n)."""
    with torch.enable_grad():
        copies = per_player_copies(x)
        copies = copies if copies.requires_grad else copies.detach().requires_grad_()
        penalty = game.penalty(game.constraint(copies, theta.unsqueeze(-2).expand(copies.shape[:-1])))
        total = penalty.diagonal(dim1=-2, dim2=-1).sum()
        return torch.autograd.grad(total, copies, create_graph=create_graph)[0]


def dynamics_jacobian(game: Game, x: Tensor, u: Tensor) -> Tensor:
    """Each player's df_i / dx_i at fixed control, (B, P, n), (B, P, m) -> (B, P, n, n)."""
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        return jacobian_rows(game.dynamics(x, u.detach()), x).movedim(0, -2)


def jacobian_rows(output: Tensor, point: Tensor) -> Tensor:
    """Gradient of each last-axis entry of `output`, summed over its other axes, (k, *point)."""
    size = output.shape[-1]
    basis = torch.eye(size, dtype=output.dtype, device=output.device)
    seeds = basis.view(size, *(1,) * (output.dim() - 1), size).expand(size, *output.shape)
    return torch.autograd.grad(output, point, seeds, is_grads_batched=True, materialize_grads=True)[0]


def terminal_costate(game: Game, x: Tensor, *, create_graph: bool = False) -> Tensor:
    """dV_i / dx_j at the end, (B, P, n) -> (B, P, P, n)."""
    with torch.enable_grad():
        copies = per_player_copies(x)
        copies = copies if copies.requires_grad else copies.detach().requires_grad_()
        total = game.terminal_value(copies).diagonal(dim1=-2, dim2=-1).sum()
        return torch.autograd.grad(total, copies, create_graph=create_graph)[0]


def pmp_rate(game: Game, x: Tensor, own: Tensor, theta: Tensor, *, create_graph: bool = False) -> tuple[Tensor, Tensor]:
    """Time derivatives of states and own costates with the optimal controls inserted.

    Args:
        game: the game; its dynamics are decoupled.
        x: states, (B, P, n).
        own: own costates dV_i / dx_i, (B, P, n).
        theta: player types, (B, P).
        create_graph: keep the result differentiable in `x` and `own`.

    Returns:
        dx/dt and d(own)/dt = -dH_i/dx_i at fixed control, each (B, P, n).
    """
    with torch.enable_grad():
        x = x if x.requires_grad else x.detach().requires_grad_()
        u = game.best_response(x, own)
        held = x.view_as(x)  # differentiating in this alias leaves the control's dependence on x out
        flow = game.dynamics(held, u)
        transport = torch.autograd.grad(flow, held, own, create_graph=create_graph, retain_graph=True)[0]
        penalty = own_costate(penalty_gradient(game, x, theta, create_graph=create_graph))
    return flow, penalty - transport
