"""Several starting trajectories per state, one for each way the players may get out of each other's way."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import torch
from torch import Tensor

from hno.games import Game
from hno.pontryagin.descent import descend
from hno.pontryagin.joint import JointProblem


class Search(NamedTuple):
    """Settings of the search for starting trajectories."""

    amplitudes: tuple[float, ...] = (0.03, 0.06, 0.12, 0.25, 0.5, 1.0)
    """Sizes of the evasive manoeuvres that are tried, in half widths of the control box."""
    margin: float = 0.6
    """Constraint tightening while the manoeuvres are sorted out, m for distance constraints."""
    coarse_iterations: int = 12
    """Descent iterations with the margin, for every manoeuvre."""
    fine_iterations: int = 25
    """Descent iterations without it, for the manoeuvres that are kept."""
    kept: int = 3
    """Starting trajectories per state that go on."""
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
        game: the game, float64.
        start: initial states, (B, P, n).
        theta: player types, (B, P).
        search: settings.
    """
    shapes = manoeuvres(game, dtype=start.dtype, device=start.device)
    count, size = len(shapes), len(start)
    x_rows, theta_rows = start.repeat_interleave(count, 0), theta.repeat_interleave(count, 0)
    guarded = JointProblem(game, theta_rows, search.margin)
    v = _best_amplitude(guarded, x_rows, shapes.repeat(size, 1, 1, 1), search.amplitudes)
    x, v, cost = descend(guarded, x_rows, v, search.coarse_iterations, search.tolerance)
    kept = min(search.kept, count)
    order = _distinct_cost(x.unflatten(0, (size, count)), cost.view(size, count)).argsort(-1)[:, :kept]
    rows = (order + count * torch.arange(size, device=start.device).unsqueeze(-1)).flatten()
    exact = JointProblem(game, theta_rows[rows])
    x, v, cost = descend(exact, x_rows[rows], v[rows], search.fine_iterations, search.tolerance)
    u = exact.control(v)
    x, u, cost = (part.unflatten(0, (size, kept)) for part in (x, u, cost))
    cost, order = _distinct_cost(x, cost).sort(-1)
    batch = torch.arange(size, device=start.device).unsqueeze(-1)
    return Starts(x[batch, order], u[batch, order], cost)


def manoeuvres(game: Game, *, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Shapes of evasive manoeuvres in scaled controls: out and back, per channel and sign pattern, (S, N, P, m).

    One channel at a time, every player goes one way or the other; the first shape is no manoeuvre at all.
    """
    steps = round(game.horizon / game.label_step)
    wave = torch.sin(2 * torch.pi * (torch.arange(steps, dtype=dtype, device=device) + 0.5) / steps)
    players, controls = game.players, game.control_dim
    signs = torch.tensor(list(itertools.product((1.0, -1.0), repeat=players)), dtype=dtype, device=device)
    channels = torch.eye(controls, dtype=dtype, device=device)
    patterns = torch.einsum("sp,km->skpm", signs, channels).flatten(0, 1)
    patterns = torch.cat([torch.zeros_like(patterns[:1]), patterns])
    return wave.view(-1, 1, 1) * patterns.unsqueeze(1)


def _best_amplitude(problem: JointProblem, start: Tensor, shape: Tensor, amplitudes: tuple[float, ...]) -> Tensor:
    """The cheapest size of each manoeuvre around the controls of a player at rest, (R, N, P, m)."""
    neutral = problem.scaled(problem.game.best_response(start, torch.zeros_like(start))).unsqueeze(1)
    tried = [(neutral + size * shape).clamp(-1, 1) for size in amplitudes]
    costs = torch.stack([problem.cost(problem.rollout(start, v), v) for v in tried])
    rows = torch.arange(len(start), device=start.device)
    return torch.stack(tried)[costs.argmin(0), rows]


def _distinct_cost(x: Tensor, cost: Tensor, tolerance: float = 1e-2) -> Tensor:
    """Costs with inf for every trajectory that repeats a cheaper one, (B, S)."""
    spread = x.amax((1, 2), keepdim=True) - x.amin((1, 2), keepdim=True)
    shape = (x / spread.clamp_min(1e-6)).flatten(2)
    apart = (shape.unsqueeze(1) - shape.unsqueeze(2)).abs().amax(-1)
    order = cost.argsort(dim=-1, stable=True).argsort(dim=-1)
    cheaper = order.unsqueeze(-1) > order.unsqueeze(-2)
    return cost.masked_fill(((apart < tolerance) & cheaper).any(-1), torch.inf)
