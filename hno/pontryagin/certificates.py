"""How far a solved trajectory can be trusted: re-integration of its controls, and what a player gains by deviating."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from hno.games import Game
from hno.pontryagin.collocation import Collocation, Iterate
from hno.pontryagin.descent import descend
from hno.pontryagin.held_controls import HeldControls
from hno.pontryagin.integrate import runge_kutta
from hno.pontryagin.mesh import label_places, label_times
from hno.pontryagin.starts import Search, at_rest, best_amplitude, manoeuvres


def replay(game: Game, at: Iterate, substeps: int = 2) -> tuple[Tensor, Tensor]:
    """Drive the states from their start with the controls of a solution, by Runge-Kutta steps.

    Args:
        game: the game, float64.
        at: states and own costates on a mesh.
        substeps: steps in each mesh interval.

    Returns:
        States at the end (B, P, n), and V_i of what was driven, by Simpson's rule (B, P).
    """
    equations, theta = Collocation(game), at.theta
    share = torch.linspace(0, 1, 2 * substeps + 1, dtype=at.z.dtype, device=at.z.device)
    u = game.best_response(*equations.split(equations.interpolate(at, share)))
    x, dt = equations.split(at.z[:, 0])[0], at.t.diff(dim=-1)[..., None, None] / substeps
    cost = torch.zeros_like(theta)
    for k in range(dt.shape[1]):
        for s in range(0, 2 * substeps, 2):
            first, middle, last = u[:, k, s : s + 3].unbind(1)
            half = runge_kutta(game, x, first, dt[:, k] / 2, ((first + middle) / 2, middle))
            end = runge_kutta(game, x, first, dt[:, k], (middle, last))
            rates = [game.running_cost(*pair, theta) for pair in ((x, first), (half, middle), (end, last))]
            cost = cost + dt[:, k, 0] / 6 * (rates[0] + 4 * rates[1] + rates[2])
            x = end
    return x, game.terminal_value(x) - cost


def reintegration_error(game: Game, at: Iterate) -> Tensor:
    """Largest distance between the ends of a solution and of its re-integration, in widths of the PDE box, (B,)."""
    end = Collocation(game).split(at.z[:, -1])[0]
    return ((replay(game, at)[0] - end).abs() / game.state_box.width).amax((-2, -1)).nan_to_num(nan=torch.inf)


def local_gap(game: Game, at: Iterate, iterations: int = 10) -> Tensor:
    """What each player gains when it re-optimises its own controls from those of the solution.

    The others keep their open-loop controls. Before and after are compared in the same discretisation, with controls
    held in the halves of the mesh intervals; what that costs falls with the fourth power of their length.

    Args:
        game: the game, float64.
        at: states and own costates on a mesh.
        iterations: budget of the descent.

    Returns:
        Gain relative to the player's cost (to 1 where that is smaller), (B, P).
    """
    equations = Collocation(game)
    t = torch.cat([at.t, (at.t[:, 1:] + at.t[:, :-1]) / 2], 1).sort(dim=-1).values
    fine = Iterate(t, equations.at_times(at, t), at.theta)
    share = torch.tensor([0.0, 0.5, 1.0], dtype=t.dtype, device=t.device)
    start, middle, end = game.best_response(*equations.split(equations.interpolate(fine, share))).unbind(2)
    held, x0 = (start + 4 * middle + end) / 6, equations.split(at.z[:, 0])[0]
    problem, rows = _each_alone(game, t, at.theta)
    v, x0 = problem.scaled(held)[rows].clamp(-1, 1), x0[rows]
    before = problem.cost(problem.rollout(x0, v), v)
    after = descend(problem, x0, v, iterations, 1e-6)[2]
    return _relative(before - after, before, at.theta)


def global_gap(
    game: Game, x0: Tensor, t: Tensor, u: Tensor, theta: Tensor, search: Search, iterations: int = 8, kept: int = 2
) -> Tensor:
    """What each player gains when it re-optimises from several manoeuvres of its own.

    Args:
        game: the game.
        x0: start states, (B, P, n).
        t: times, s, (K,).
        u: controls of the solution at these times, (B, K, P, m).
        theta: player types, (B, P).
        search: amplitudes of the manoeuvres, and how coarse the controls are.
        iterations: budget of the descents.
        kept: manoeuvres that are refined, the cheapest ones.

    Returns:
        Gain over the refined solution itself, relative as for `local_gap`, (B, P). The controls are coarser than the
        solution's, so that gains below some 1e-3 mean nothing.
    """
    game = copy.deepcopy(game).float()
    x0, u, theta = x0.float(), u.float(), theta.float()
    labels = label_times(game, dtype=theta.dtype, device=theta.device)
    nodes = torch.arange(0, len(labels) - 1, search.coarse, device=theta.device)
    times = torch.cat([labels[nodes], labels[-1:]])
    alone, rows = _each_alone(game, times, theta, points=search.points * search.coarse)
    start = x0[rows]
    own = alone.scaled(u)[rows][:, label_places(t.float().unsqueeze(0), times[:-1])[0]].clamp(-1, 1)
    shapes = manoeuvres(game, 1, dtype=theta.dtype, device=theta.device)[:, nodes] * alone.acts[:, None, None, :, None]
    rest = torch.where(alone.acts[:, None, :, None] > 0, at_rest(alone, start).unsqueeze(1), own)
    number = torch.arange(len(rows), device=theta.device)
    many = number.repeat_interleave(shapes.shape[1])
    tried, cost = best_amplitude(alone.rows(many), start[many], rest[many], shapes.flatten(0, 1), search.amplitudes)
    best = cost.view(len(rows), -1).topk(kept, largest=False).indices
    tried = torch.cat([own.unsqueeze(1), tried.view(*shapes.shape)[number.unsqueeze(-1), best]], 1)
    many = number.repeat_interleave(1 + kept)
    reached = descend(alone.rows(many), start[many], tried.flatten(0, 1), iterations, search.tolerance)[2]
    before, *others = reached.view(len(rows), -1).unbind(-1)
    return _relative(before - torch.stack(others).amin(0), before, theta)


def _each_alone(game: Game, t: Tensor, theta: Tensor, points: int = 2) -> tuple[HeldControls, Tensor]:
    """The own problem of every player of every row, players running fastest, and the row of each."""
    rows = torch.arange(len(theta), device=theta.device).repeat_interleave(game.players)
    ego = torch.arange(game.players, device=theta.device).repeat(len(theta))
    return HeldControls(game, t.expand(len(theta), -1)[rows], theta[rows], ego=ego, points=points), rows


def _relative(gain: Tensor, cost: Tensor, theta: Tensor) -> Tensor:
    return (gain / cost.abs().clamp_min(1)).clamp_min(0).view(theta.shape).double()
