"""Open-loop Nash equilibria of a game: initial states and player types in, extremals with a status out."""

from __future__ import annotations

import copy
from typing import NamedTuple

import torch
from torch import Tensor

from hno.games import Game
from hno.games.base import own_costate
from hno.games.potential import Team, require_potential
from hno.pontryagin.certificates import global_gap, local_gap, reintegration_error
from hno.pontryagin.collocation import Collocation, Iterate
from hno.pontryagin.integrate import runge_kutta
from hno.pontryagin.mesh import encounter_weight, graded_mesh, inner_times, label_places, label_times
from hno.pontryagin.newton import Newton, Solved, newton, rescue
from hno.pontryagin.saturation import nodes_at_kinks
from hno.pontryagin.starts import Search, Starts, cheapest, find_starts
from hno.pontryagin.sweep import costates, values
from hno.pontryagin.threads import torch_threads
from hno.types import Extremal, Numbers, Status, join, tensor_of


class Solver(NamedTuple):
    """Settings of `solve`; labels are cached under them."""

    search: Search = Search()
    newton: Newton = Newton()
    extra_nodes: int = 60
    """Mesh nodes beyond the label nodes, placed where the cost of states varies."""
    reintegration: float = 1e-4
    """Largest re-integration error of a label, in widths of the PDE box."""
    chunk: int = 128
    """States that are solved together; bounds the memory."""


def solve(
    game: Game,
    x0: Numbers,
    theta: Numbers,
    settings: Solver = Solver(),
    threads: int = 1,
    *,
    all_equilibria: bool = False,
) -> Extremal:
    """The cheapest open-loop equilibrium found from several starts, for every initial state, or all that were found.

    Args:
        game: any game; it is solved in float64 on the device of `x0`.
        x0: initial states, (B, P, n).
        theta: player types, (B, P).
        settings: solver settings.
        threads: of torch, see `torch_threads`.
        all_equilibria: return every distinct equilibrium, not only the cheapest.

    Returns:
        One extremal per row, or several, the cheapest first: `Extremal.start` says to which row of `x0` each belongs.
        Rows without a converged start carry the status and residual of their best attempt.

    Raises:
        ValueError: wrong shapes or entries that are not finite, or a game that says wrongly that it has a potential.
    """
    x0, theta = tensor_of("x0", x0), tensor_of("theta", theta)
    _check(game, x0, theta)
    with (
        torch_threads(threads),
        torch.inference_mode(False),
    ):  # adjoints are gradients, which that mode would turn into zeros
        game = copy.deepcopy(game).to(x0.device).double()
        x0, theta = x0.detach().clone().double(), theta.detach().clone().to(x0.device).double()
        parts = zip(x0.split(settings.chunk), theta.split(settings.chunk), strict=True)
        found = [solve_on_mesh(game, *part, settings, all_equilibria=all_equilibria) for part in parts]
        return join([_describe(game, part, settings) for part in found])


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
    if game.potential:
        require_potential(game)


def _first_bad_row(tensor: Tensor) -> int:
    return int((~tensor.isfinite()).flatten(1).any(-1).nonzero()[0])


class OnMesh(NamedTuple):
    """The best trajectory of every state, or all of them, each on its own mesh."""

    at: Iterate
    """States and own costates."""
    residual: Tensor
    """Largest scaled collocation residuals, (B,)."""
    status: Tensor
    """`Status`, (B,)."""
    alternatives: Tensor
    """Sums of values of all starts, NaN where they did not converge, (B, S)."""
    state: Tensor
    """The row of x0 that each trajectory starts from, (B,)."""


def solve_on_mesh(
    game: Game, x0: Tensor, theta: Tensor, settings: Solver = Solver(), *, all_equilibria: bool = False
) -> OnMesh:
    """What `solve` does up to the certificates and the label grid: all states at once, in float64."""
    with torch.no_grad():
        starts = find_starts(copy.deepcopy(game).float(), x0.float(), theta.float(), settings.search)
        starts = Starts(*(part.double() for part in starts))
        starts.x[:, :, 0] = x0.unsqueeze(1)  # single precision is for the search only
        tried = starts.cost.isfinite()
        tried[:, 0] = True  # where no start is finite, one fails in Newton and carries the status
        state, start = tried.nonzero().unbind(-1)
        x, u = starts.x[state, start], starts.u[state, start]
        iterate = _initial_iterate(game, x, u, theta[state], settings.extra_nodes)
        equations = Collocation(game)
        found = newton(equations, iterate, settings.newton)
        place, converged = _places(tried, found.status)
        hopeless = place[tried & ~converged.any(1, keepdim=True)]
        found = rescue(equations, iterate, found, hopeless, settings.newton)
        iterate = iterate._replace(z=found.z)
        best, totals = _best(_total(game, iterate), found, tried)
        start, state = best.squeeze(1), torch.arange(len(x0), device=x0.device)
        if all_equilibria:
            state, start = _distinct(game, iterate, place, totals, best)
        row = place[state, start]
        at, size, status = nodes_at_kinks(
            game, iterate.rows(row), found.residual[row], found.status[row], settings.newton, settings.reintegration
        )
        totals[state, start] = _total(game, at).where(status == Status.CONVERGED, torch.nan)
        return OnMesh(at, size, status, totals[state], state)


def _initial_iterate(game: Game, x: Tensor, u: Tensor, theta: Tensor, extra: int) -> Iterate:
    """Put a trajectory of held controls on a graded mesh and add its own costates."""
    labels = label_times(game, dtype=x.dtype, device=x.device)
    t = graded_mesh(labels, _encounter_weight(game, labels, x, u, theta), extra)
    middle = (t[:, 1:] + t[:, :-1]) / 2
    at_nodes = _held(game, labels, x, u, t)
    at_middle = _held(game, labels, x, u, middle)
    own = own_costate(costates(game, t, *at_nodes, at_middle, theta))
    return Iterate(t, torch.cat([at_nodes[0].flatten(-2), own.flatten(-2)], -1), theta)


def _held(game: Game, labels: Tensor, x: Tensor, u: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """States and controls at times t (B, K) of a trajectory with controls held between label nodes."""
    left = (torch.searchsorted(labels, t.contiguous(), right=True) - 1).clamp(0, len(labels) - 2)
    rows = torch.arange(len(t), device=t.device).unsqueeze(-1)
    control = u[rows, left]
    return runge_kutta(game, x[rows, left], control, (t - labels[left])[..., None, None]), control


def _encounter_weight(game: Game, labels: Tensor, x: Tensor, u: Tensor, theta: Tensor) -> Tensor:
    """Where a trajectory of held controls needs nodes, (B, L - 1)."""
    since = inner_times(labels) - labels[:-1, None]
    inside = (-1, -1, since.shape[-1], -1, -1)
    inner = runge_kutta(game, x[:, :-1, None].expand(inside), u[:, :, None].expand(inside), since[..., None, None])
    return encounter_weight(game.uncontrolled_cost(inner, theta[:, None, None].expand(inner.shape[:-1])))


class Along(NamedTuple):
    """States and controls of an iterate, at the nodes and at the interval centres."""

    x: Tensor
    u: Tensor
    middle: tuple[Tensor, Tensor]


def along_mesh(game: Game, at: Iterate) -> Along:
    """States and optimal controls of an iterate."""
    equations = Collocation(game)
    centre = equations.midpoint(at.z, equations.rate(at.z, at.theta), at.t.diff(dim=-1))
    (x, own), (middle_x, middle_own) = equations.split(at.z), equations.split(centre)
    return Along(x, game.best_response(x, own), (middle_x, game.best_response(middle_x, middle_own)))


def _total(game: Game, at: Iterate) -> Tensor:
    """Sum of the players' values from the start, (B,)."""
    return values(game, at.t, *along_mesh(game, at), at.theta)[:, 0].sum(-1)


def _places(tried: Tensor, status: Tensor) -> tuple[Tensor, Tensor]:
    """The row of every start of every state, and which of them converged, (B, S)."""
    place = torch.full(tried.shape, -1, device=tried.device)
    place[tried] = torch.arange(len(status), device=tried.device)
    return place, tried & (status[place] == Status.CONVERGED)


def _best(total: Tensor, found: Solved, tried: Tensor) -> tuple[Tensor, Tensor]:
    """For each state the converged start with the largest sum of values, or else the smallest residual.

    Args:
        total: sum of values of every start that was tried, (R,).
        found: where Newton ended, R rows.
        tried: which starts those are, (B, S).

    Returns:
        The best start of each state, (B, 1), and the totals, NaN where a start did not converge, (B, S).
    """
    place, converged = _places(tried, found.status)
    totals = torch.where(converged, total[place], torch.nan)
    score = torch.where(converged, totals, -1e30 * (1 + found.residual[place].clamp_max(1e30)))
    return score.masked_fill(~tried, -torch.inf).argmax(1, keepdim=True), totals


def _distinct(game: Game, at: Iterate, place: Tensor, totals: Tensor, best: Tensor) -> tuple[Tensor, Tensor]:
    """The state and the start of every distinct equilibrium, those of one state together and the best one first.

    A state without an equilibrium has its best attempt.
    """
    row = place.where(totals.isfinite(), place.gather(1, best))
    nodes = label_places(at.t, label_times(game, dtype=at.t.dtype, device=at.t.device))
    x = Collocation(game).split(at.z)[0][torch.arange(len(nodes), device=nodes.device).unsqueeze(-1), nodes]
    cost, order = cheapest(x[row.flatten()], -totals.nan_to_num(-torch.inf).flatten(), len(row))
    start, found = order % row.shape[1], cost.isfinite()
    start[:, :1], found[:, 0] = best, True
    state, rank = found.nonzero().unbind(-1)
    return state, start[state, rank]


def _describe(game: Game, found: OnMesh, settings: Solver) -> Extremal:
    """Extremals on the label grid, with their certificates."""
    at, residual, status, totals, state = found
    path = x, u, middle = along_mesh(game, at)
    costate = costates(game, at.t, *path, at.theta)
    value = values(game, at.t, *path, at.theta)
    if game.potential:
        potential = values(Team(game), at.t, *path, at.theta).squeeze(-1)
    else:
        potential = torch.full_like(at.t, torch.nan)
    everywhere = torch.cat([x, middle[0]], 1)
    clearance = -game.constraint(everywhere, at.theta.unsqueeze(1).expand(everywhere.shape[:-1])).amax((1, 2, 3))
    t = label_times(game, dtype=x.dtype, device=x.device)
    drift = reintegration_error(game, at)
    status = status.masked_fill((status == Status.CONVERGED) & (drift > settings.reintegration), Status.INACCURATE)
    rows = torch.arange(len(x), device=x.device).unsqueeze(-1)
    nodes = label_places(at.t, t)
    x, costate, u, value, potential = (part[rows, nodes] for part in (x, costate, u, value, potential))
    parts = x, costate, u, value, clearance, drift, *((potential,) if game.potential else ())
    finite = torch.stack([part.reshape(len(x), -1).isfinite().all(-1) for part in parts]).all(0)
    return Extremal(
        status=status.masked_fill((status == Status.CONVERGED) & ~finite, Status.NOT_FINITE),
        residual=residual,
        t=t,
        x=x,
        costate=costate,
        u=u,
        value=value,
        theta=at.theta,
        potential=potential,
        start=state,
        clearance=clearance,
        reintegration=drift,
        local_gap=local_gap(game, at),
        global_gap=global_gap(game, x[:, 0], t, u, at.theta, settings.search),
        alternatives=totals,
    )
