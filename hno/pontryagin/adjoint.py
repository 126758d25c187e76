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


def cost_gradient(game: Game, x: Tensor, theta: Tensor, *, create_graph: bool = False) -> Tensor:
    """Gradient of every player's running cost in every player's state at fixed control, (B, P, n) -> (B, P, P, n)."""
    with torch.enable_grad():
        copies = per_player_copies(x)
        copies = copies if copies.requires_grad else copies.detach().requires_grad_()
        cost = game.uncontrolled_cost(copies, theta.unsqueeze(-2).expand(copies.shape[:-1]))
        return gradient_of(cost.diagonal(dim1=-2, dim2=-1).sum(), copies, create_graph=create_graph)


def dynamics_jacobian(game: Game, x: Tensor, u: Tensor) -> Tensor:
    """Each player's df_i / dx_i at fixed control, (B, P, n), (B, P, m) -> (B, P, n, n)."""
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        return jacobian_rows(game.dynamics(x, u.detach()), x).movedim(0, -2)


def gradient_of(output: Tensor, point: Tensor, weight: Tensor | None = None, *, create_graph: bool = False) -> Tensor:
    """Gradient of a scalar, or of a weighted sum; zero if nothing depends on the point. The graph is kept."""
    if not output.requires_grad:
        return torch.zeros_like(point)
    options = {"create_graph": create_graph, "retain_graph": True, "materialize_grads": True}
    return torch.autograd.grad(output, point, weight, **options)[0]


def jacobian_rows(output: Tensor, point: Tensor) -> Tensor:
    """Gradient of each last-axis entry of `output`, summed over its other axes, (k, *point)."""
    size = output.shape[-1]
    if not output.requires_grad:
        return torch.zeros(size, *point.shape, dtype=point.dtype, device=point.device)
    basis = torch.eye(size, dtype=output.dtype, device=output.device)
    seeds = basis.view(size, *(1,) * (output.dim() - 1), size).expand(size, *output.shape)
    return torch.autograd.grad(output, point, seeds, is_grads_batched=True, materialize_grads=True)[0]


def terminal_costate(game: Game, x: Tensor, *, create_graph: bool = False) -> Tensor:
    """dV_i / dx_j at the end, (B, P, n) -> (B, P, P, n)."""
    with torch.enable_grad():
        copies = per_player_copies(x)
        copies = copies if copies.requires_grad else copies.detach().requires_grad_()
        total = game.terminal_value(copies).diagonal(dim1=-2, dim2=-1).sum()
        return gradient_of(total, copies, create_graph=create_graph)


def drift_rate(game: Game, x: Tensor, own: Tensor, *, create_graph: bool = False) -> tuple[Tensor, Tensor]:
    """The part of `pmp_rate` without the running cost; that of player i depends on (x_i, own_i) alone.

    Returns:
        dx/dt and -(df_i/dx_i)' own_i at fixed control, each (B, P, n).
    """
    with torch.enable_grad():
        x = x if x.requires_grad else x.detach().requires_grad_()
        u = game.best_response(x, own)
        held = x.view_as(x)  # differentiating in this alias leaves the control's dependence on x out
        flow = game.dynamics(held, u)
        transport = gradient_of(flow, held, own, create_graph=create_graph)
    return flow, -transport


def pmp_rate(game: Game, x: Tensor, own: Tensor, theta: Tensor) -> tuple[Tensor, Tensor]:
    """Time derivatives of states and own costates with the optimal controls inserted.

    Args:
        game: the game; its dynamics are decoupled.
        x: states, (B, P, n).
        own: own costates dV_i / dx_i, (B, P, n).
        theta: player types, (B, P).

    Returns:
        dx/dt and d(own)/dt = -dH_i/dx_i at fixed control, each (B, P, n).
    """
    flow, transport = drift_rate(game, x, own)
    return flow.detach(), own_costate(cost_gradient(game, x, theta)) + transport


def pmp_rate_and_jacobian(game: Game, x: Tensor, own: Tensor, theta: Tensor) -> tuple[Tensor, Tensor]:
    """The rate of z = (x, own), flattened, and its derivative in z; arguments as for `pmp_rate`.

    Only the running cost couples the players: the rest of the Jacobian is one block per player.

    Returns:
        (B, D) and (B, D, D) with D = 2 P n.
    """
    players, states = x.shape[-2:]
    with torch.enable_grad():
        both = torch.cat([x, own], -1).detach().requires_grad_()
        drift = torch.cat(drift_rate(game, *both.split(states, -1), create_graph=True), -1)
        blocks = jacobian_rows(drift, both).movedim(0, -2).unflatten(-1, (2, states)).unflatten(-3, (2, states))
        flat = x.flatten(-2).detach().requires_grad_()
        load = cost_gradient(game, flat.unflatten(-1, (players, states)), theta, create_graph=True)
        load = own_costate(load).flatten(-2)
        curvature = jacobian_rows(load, flat).movedim(0, -2)
    rate = torch.cat([part.flatten(-2) for part in drift.detach().split(states, -1)], -1)
    alone = torch.eye(players, dtype=x.dtype, device=x.device)
    jacobian = torch.einsum("...iakbl,ij->...aikbjl", blocks, alone).flatten(-6, -4).flatten(-3)
    half = players * states
    rate[..., half:] += load.detach()
    jacobian[..., half:, :half] += curvature
    return rate, jacobian
