"""Several starting trajectories per state, one for each way the players may get out of each other's way."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import torch
from torch import Tensor

from hno.games import Game
from hno.pontryagin.descent import descend
from hno.pontryagin.held_controls import HeldControls
from hno.pontryagin.mesh import label_steps, label_times


class Search(NamedTuple):
    """Settings of the search for starting trajectories."""

    amplitudes: tuple[float, ...] = (0.03, 0.06, 0.12, 0.25, 0.5, 1.0)
    """Sizes of the evasive manoeuvres that are tried, in half widths of the control box."""
    margin: float = 0.6
    """Constraint tightening while the manoeuvres are sorted out, m for distance constraints."""
    rounds: tuple[tuple[int, int], ...] = ((4, 4), (8, 2))
    """Descent iterations with the margin, and the number of manoeuvres per state that are kept after them."""
    fine_iterations: int = 25
    """Descent iterations without the margin, for the manoeuvres that are kept at last."""
    coarse: int = 2
    """Label intervals that share a control while the manoeuvres are sorted out."""
    points: int = 4
    """Penalty evaluations in each label interval."""
    tolerance: float = 1e-4
    """Relative decrease at which a descent ends."""


class Starts(NamedTuple):
    """Starting trajectories on the label grid, the cheapest first."""

    x: Tensor
    """States, (B, S, N + 1, P, n)."""
    u: Tensor
    """Held controls, (B, S, N, P, m)."""
    cost: Tensor
    """Joint cost with the stand-in penalty, inf for a repetition of a cheaper start, (B, S)."""


def find_starts(game: Game, start: Tensor, theta: Tensor, search: Search) -> Starts:
    """Descend on the joint cost from one manoeuvre per control channel and sign pattern of the players.

    Args:
        game: the game, in the precision of the states; single precision is enough.
        start: initial states, (B, P, n).
        theta: player types, (B, P).
        search: settings.
    """
    t = label_times(game, dtype=start.dtype, device=start.device)
    nodes = torch.arange(0, len(t) - 1, search.coarse, device=start.device)
    times = torch.cat([t[nodes], t[-1:]])
    shapes = manoeuvres(game, game.players, dtype=start.dtype, device=start.device)[:, nodes]
    size, count = len(start), len(shapes)
    rows = torch.arange(size, device=start.device).repeat_interleave(count)
    guarded = HeldControls(game, times, theta[rows], margin=search.margin, points=search.points * search.coarse)
    base = at_rest(guarded, start[rows]).unsqueeze(1).expand(-1, len(nodes), -1, -1)
    v, _ = best_amplitude(guarded, start[rows], base, shapes.repeat(size, 1, 1, 1), search.amplitudes)
    for iterations, kept in search.rounds:
        x, v, cost = descend(guarded, start[rows], v, iterations, search.tolerance)
        best = cheapest(x, cost, size)[1][:, :kept].flatten()
        rows, v, guarded = rows[best], v[best], guarded.rows(best)
    exact = HeldControls(game, t, theta[rows], points=search.points, distinct=guarded.distinct)
    v = v.repeat_interleave(search.coarse, 1)[:, : exact.steps]
    x, v, cost = descend(exact, start[rows], v, search.fine_iterations, search.tolerance)
    cost, order = cheapest(x, cost, size)
    return Starts(x[order], exact.control(v)[order], cost)


def manoeuvres(game: Game, players: int, *, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Shapes of evasive manoeuvres in scaled controls: out and back, per channel and sign pattern, (S, N, P, m).

    One channel at a time, every player goes one way or the other; the first shape is no manoeuvre at all. With
    `players` = 1 the shapes fit any one player.
    """
    steps = label_steps(game)
    wave = torch.sin(2 * torch.pi * (torch.arange(steps, dtype=dtype, device=device) + 0.5) / steps)
    controls = game.control_dim
    signs = torch.tensor(list(itertools.product((1.0, -1.0), repeat=players)), dtype=dtype, device=device)
    channels = torch.eye(controls, dtype=dtype, device=device)
    patterns = torch.einsum("sp,km->skpm", signs, channels).flatten(0, 1)
    patterns = torch.cat([torch.zeros_like(patterns[:1]), patterns])
    return wave.view(-1, 1, 1) * patterns.unsqueeze(1)


def at_rest(problem: HeldControls, start: Tensor) -> Tensor:
    """Scaled controls of players who want nothing, (R, P, m)."""
    return problem.scaled(problem.game.best_response(start, torch.zeros_like(start)))


def best_amplitude(
    problem: HeldControls, start: Tensor, base: Tensor, shape: Tensor, amplitudes: tuple[float, ...]
) -> tuple[Tensor, Tensor]:
    """The cheapest size of each manoeuvre.

    Args:
        problem: a problem of R rows.
        start: initial states, (R, P, n).
        base: scaled controls without the manoeuvre, (R, N, P, m).
        shape: the manoeuvre, (R, N, P, m).
        amplitudes: sizes to try.

    Returns:
        Scaled controls (R, N, P, m) and their cost (R,).
    """
    tried = [(base + size * shape).clamp(-1, 1) for size in amplitudes]
    costs = torch.stack([problem.cost(problem.rollout(start, v), v) for v in tried])
    rows = torch.arange(len(start), device=start.device)
    cost, best = costs.nan_to_num(torch.inf).min(0)
    return torch.stack(tried)[best, rows], cost


def cheapest(x: Tensor, cost: Tensor, size: int, tolerance: float = 1e-2) -> tuple[Tensor, Tensor]:
    """Sort the starts of each state by cost, with repetitions of a cheaper one last.

    Args:
        x: states, rows of one initial state after the other, (size * S, N + 1, P, n).
        cost: joint cost, (size * S,).
        size: number of initial states.
        tolerance: largest deviation of a repetition, in widths of the state's own range.

    Returns:
        Costs, inf for repetitions, and the rows they belong to, both (size, S).
    """
    x, cost = x.unflatten(0, (size, -1)), cost.unflatten(0, (size, -1))
    spread = x.amax((1, 2), keepdim=True) - x.amin((1, 2), keepdim=True)
    shape = (x / spread.clamp_min(1e-6)).flatten(2)
    apart = torch.cdist(shape, shape, p=torch.inf)
    rank = cost.argsort(dim=-1, stable=True).argsort(dim=-1)
    repeats = ((apart < tolerance) & (rank.unsqueeze(-1) > rank.unsqueeze(-2))).any(-1)
    cost, order = cost.masked_fill(repeats, torch.inf).sort(dim=-1, stable=True)
    return cost, order + len(cost[0]) * torch.arange(size, device=cost.device).unsqueeze(-1)
