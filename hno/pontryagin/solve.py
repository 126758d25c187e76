"""Open-loop Nash equilibria of a game: initial states and player types in, extremals with a status out."""

from __future__ import annotations

import copy
from typing import NamedTuple

import torch
from torch import Tensor

from hno.games import Game
from hno.games.base import own_costate
from hno.pontryagin.collocation import Collocation, Iterate, Newton, newton
from hno.pontryagin.integrate import runge_kutta
from hno.pontryagin.mesh import Mesh, graded_mesh, label_times
from hno.pontryagin.starts import Search, Starts, find_starts
from hno.pontryagin.sweep import costates, values
from hno.types import Extremal, Status


class Solver(NamedTuple):
    """Settings of `solve`; labels are cached under them."""

    search: Search = Search()
    newton: Newton = Newton()
    extra_nodes: int = 60
    """Mesh nodes beyond the label nodes, placed where the penalty acts."""
    chunk: int = 128
    """States that are solved together; bounds the memory."""


def solve(game: Game, x0: Tensor, theta: Tensor, settings: Solver = Solver()) -> Extremal:
    """The cheapest open-loop equilibrium found from several starts, for every initial state.

    Args:
        game: any game; it is solved in float64 on the device of `x0`.
        x0: initial states, (B, P, n).
        theta: player types, (B, P).
        settings: solver settings.

    Returns:
        One extremal per row. Rows without a converged start carry the status and residual of their best attempt.

    Raises:
        ValueError: wrong shapes or entries that are not finite.
    """
    _check(game, x0, theta)
    game = copy.deepcopy(game).to(x0.device).double()
    parts = zip(x0.double().split(settings.chunk), theta.double().split(settings.chunk), strict=True)
    return join([_solve_chunk(game, *part, settings) for part in parts])


def join(parts: list[Extremal]) -> Extremal:
    """Extremals of one game, one after the other."""
    batched = {name: torch.cat([getattr(part, name) for part in parts]) for name in Extremal._fields if name != "t"}
    return Extremal(t=parts[0].t, **batched)


def _check(game: Game, x0: Tensor, theta: Tensor) -> None:
    expected = (game.players, game.state_dim)
    if x0.dim() != 3 or tuple(x0.shape[1:]) != expected or len(x0) == 0:
        raise ValueError(f"x0 must have shape (B, {expected[0]}, {expected[1]}) with B > 0; got {tuple(x0.shape)}.")
    if tuple(theta.shape) != (len(x0), game.players):
        raise ValueError(
            f"theta must have shape ({len(x0)}, {game.players}), a type per player; got {tuple(theta.shape)}."
        )
    for name, tensor in (("x0", x0), ("theta", theta)):
        if not bool(tensor.isfinite().all()):
            raise ValueError(f"{name} has entries that are not finite, first in row {_first_bad_row(tensor)}.")


def _first_bad_row(tensor: Tensor) -> int:
    return int((~tensor.isfinite()).flatten(1).any(-1).nonzero()[0])


def _solve_chunk(game: Game, x0: Tensor, theta: Tensor, settings: Solver) -> Extremal:
    with torch.no_grad():
        starts = find_starts(copy.deepcopy(game).float(), x0.float(), theta.float(), settings.search)
        starts = Starts(*(part.double() for part in starts))
        size, kept = starts.cost.shape
        types = theta.repeat_interleave(kept, 0)
        tried = starts.cost.isfinite()
        tried[:, 0] = True  # where no start is finite, one fails in Newton and carries the status
        tried = tried.flatten()
        x, u = starts.x.flatten(0, 1)[tried], starts.u.flatten(0, 1)[tried]
        iterate, mesh = _initial_iterate(game, x, u, types[tried], settings.extra_nodes)
        z, residual, status = newton(Collocation(game), iterate, settings.newton)
        found = _describe(game, iterate._replace(z=z), mesh, residual, status)
        return _best(found, tried.view(size, kept))


def _initial_iterate(game: Game, x: Tensor, u: Tensor, theta: Tensor, extra: int) -> tuple[Iterate, Mesh]:
    """Put a trajectory of held controls on a graded mesh and add its own costates."""
    labels = label_times(game, dtype=x.dtype, device=x.device)
    mesh = graded_mesh(labels, _encounter_weight(game, labels, x, u, theta), extra)
    middle = (mesh.t[:, 1:] + mesh.t[:, :-1]) / 2
    at_nodes = _held(game, labels, x, u, mesh.t)
    at_middle = _held(game, labels, x, u, middle)
    own = own_costate(costates(game, mesh.t, *at_nodes, at_middle, theta))
    return Iterate(mesh.t, torch.cat([at_nodes[0].flatten(-2), own.flatten(-2)], -1), theta), mesh


def _held(game: Game, labels: Tensor, x: Tensor, u: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """States and controls at times t (B, K) of a trajectory with controls held between label nodes."""
    left = (torch.searchsorted(labels, t.contiguous(), right=True) - 1).clamp(0, len(labels) - 2)
    rows = torch.arange(len(t), device=t.device).unsqueeze(-1)
    control = u[rows, left]
    return runge_kutta(game, x[rows, left], control, (t - labels[left])[..., None, None]), control


def _encounter_weight(game: Game, labels: Tensor, x: Tensor, u: Tensor, theta: Tensor, points: int = 10) -> Tensor:
    """How much the penalty varies within each label interval, plus a floor, (B, L - 1)."""
    share = torch.linspace(0, 1, points + 1, dtype=x.dtype, device=x.device)
    t = torch.lerp(labels[:-1, None], labels[1:, None], share)
    rows, steps = len(x), len(labels) - 1
    inner = runge_kutta(game, x[:, :-1, None], u[:, :, None], (t - labels[:-1, None])[..., None, None])
    types = theta[:, None, None].expand(rows, steps, points + 1, -1)
    penalty = game.penalty(game.constraint(inner, types)).sum(-1)
    weight = penalty.diff(dim=-1).abs().sum(-1).nan_to_num(0, 0).clamp_min(1e-12).sqrt()
    return weight / weight.amax(-1, keepdim=True) + 0.05


def _describe(game: Game, at: Iterate, mesh: Mesh, residual: Tensor, status: Tensor) -> Extremal:
    """Extremals on the label grid of solved iterates."""
    equations = Collocation(game)
    centre = equations.midpoint(at.z, equations.rate(at.z, at.theta), mesh.step)
    (x, own), (middle_x, middle_own) = equations.split(at.z), equations.split(centre)
    u, middle_u = game.best_response(x, own), game.best_response(middle_x, middle_own)
    costate = costates(game, mesh.t, x, u, (middle_x, middle_u), at.theta)
    value = values(game, mesh.t, x, u, (middle_x, middle_u), at.theta)
    rows = torch.arange(len(x), device=x.device).unsqueeze(-1)
    everywhere = torch.cat([x, middle_x], 1)
    gap = -game.constraint(everywhere, at.theta.unsqueeze(1).expand(everywhere.shape[:-1])).amax((1, 2))
    t = label_times(game, dtype=x.dtype, device=x.device)
    total = value[:, :1].sum(-1)
    x, costate, u, value = (part[rows, mesh.label_index] for part in (x, costate, u, value))
    return Extremal(status, residual, t, x, costate, u, value, at.theta, gap, total)


def _best(found: Extremal, tried: Tensor) -> Extremal:
    """For each state the converged start with the largest sum of values, or else the smallest residual.

    Args:
        found: one row per start that was tried.
        tried: which starts those are, (B, S).
    """
    place = torch.full(tried.shape, -1, device=tried.device)
    place[tried] = torch.arange(len(found.status), device=tried.device)
    converged = tried & (found.status[place] == Status.CONVERGED)
    total = torch.where(converged, found.alternatives[place, 0], torch.nan)
    score = torch.where(converged, total, -1e30 * (1 + found.residual[place].clamp_max(1e30)))
    row = place.gather(1, score.masked_fill(~tried, -torch.inf).argmax(1, keepdim=True)).squeeze(1)
    picked = {name: getattr(found, name)[row] for name in Extremal._fields if name not in ("t", "alternatives")}
    return Extremal(t=found.t, alternatives=total, **picked)
