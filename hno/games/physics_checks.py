"""Checks of what a game means: decoupled players, exact best responses, equal roles, signs, pure functions."""

from __future__ import annotations

import copy
import itertools
import warnings

import torch
from torch import Tensor

from hno.games.base import Game
from hno.games.potential import GAP, potential_gap
from hno.games.probe import Point, methods, points, require

COSTATE_SCALES = (1.0, 30.0, 1000.0)  # with optimal controls inside the control box, at its border and far outside


DECOUPLED = (
    "Coupled dynamics are outside the contract: the solver integrates the adjoints of each player's own states alone, "
    "and its search relies on a joint cost whose stationary points are then equilibria. Couple the players through "
    "`constraint`, `penalty` or `state_cost`."
)


def check_physics(game: Game) -> None:
    """Check a game in float64 whose shapes are right.

    Raises:
        ContractError: the first promise that the game breaks.
    """
    checks = (_check_fingerprint, _check_decoupled, _check_optimality, _check_roles, _check_periodic, _check_penalty)
    for check in (*checks, _check_starts, _check_signs, _check_potential, _warn_of_opposition):
        check(game)


def check_control_box(game: Game, dtype: torch.dtype) -> None:
    """Check that best responses stay inside the box.

    Raises:
        ContractError: one does not.
    """
    for scale in COSTATE_SCALES:
        at = points(game, (64,), dtype, scale)
        u = game.optimal_control(at.x, at.costate)
        excess = (u - game.control_box.clamp(u)).abs()
        inside = bool((excess <= 8 * torch.finfo(dtype).eps * u.abs()).all())
        require(inside, "optimal_control inside control_box", f"an excess of {float(excess.max()):.3g}", "Clamp it.")


def _check_optimality(game: Game) -> None:
    for seed, scale in enumerate(COSTATE_SCALES):
        at = points(game, (256,), torch.float64, scale, seed)
        u = game.optimal_control(at.x, at.costate)
        best = game.hamiltonian(at.x, at.costate, u, at.theta)
        for player, length in itertools.product(range(game.players), (1.0, 0.1, 0.01)):
            other = u.clone()
            other[..., player, :] = u[..., player, :].lerp(at.u[..., player, :], length)
            gain = (game.hamiltonian(at.x, at.costate, other, at.theta) - best)[..., player]
            met = bool((gain <= 1e-10 * (1 + best[..., player].abs())).all())
            expected = f"a Hamiltonian of player {player} that no other control in control_box raises"
            remedy = "best_response must be its exact maximiser; see ControlAffineGame for a closed form."
            require(met, expected, f"a gain of {float(gain.max()):.3g} at costates of size {scale:g}", remedy)


def _check_decoupled(game: Game) -> None:
    at, moved = (points(game, (16,), torch.float64, seed=seed) for seed in (0, 1))
    for player in range(game.players):
        mask = torch.arange(game.players) == player
        parts = zip(at, moved, strict=True)
        one_moved = Point(*(torch.where(mask.view(-1, *(1,) * (a.dim() - 2)), b, a) for a, b in parts))
        for name in ("dynamics", "effort", "best_response"):
            change = (methods(game, one_moved)[name][0]() - methods(game, at)[name][0]()).abs()
            others = change.movedim(1, 0)[~mask]
            expected = f"{name} of each player that depends on its own state, control and costate alone"
            got = f"a change of {float(others.amax() if len(others) else 0):.3g} when player {player} moves"
            require(bool((others <= 1e-9).all()), expected, got, DECOUPLED)


def _check_roles(game: Game) -> None:
    at = points(game, (16,), torch.float64)
    names = ("dynamics", "effort", "terminal_value", "constraint", "state_cost", "penalty", "sensors")
    orders = [list(o) for o in itertools.permutations(range(game.players))]
    for order in (o for o in orders if [game.roles[player] for player in o] == list(game.roles)):
        swapped = at._replace(x=at.x[:, order], u=at.u[:, order], theta=at.theta[:, order])
        pairs = {n: (methods(game, swapped)[n][0](), methods(game, at)[n][0]()[:, order]) for n in names}
        after, before = pairs["constraint"]
        pairs["constraint"] = after.sort().values, before.sort().values  # in no particular order
        for name in ("state_box", "initial_box", "control_box"):
            corners = torch.stack([getattr(game, name).lo, getattr(game, name).hi])
            corners = corners.reshape(2, -1, corners.shape[-1]).expand(2, game.players, -1)
            pairs[name] = corners, corners[:, order]
        for name, (after, before) in pairs.items():
            gap = float((after - before).abs().max() / (1 + before.abs().max()))
            expected = f"{name} to swap when players of equal role swap (roles are {game.roles})"
            remedy = f"If these players differ, declare roles = ({', '.join(map(str, range(game.players)))})."
            require(gap <= 1e-9, expected, f"a relative difference of {gap:.3g}", remedy)


def _check_periodic(game: Game) -> None:
    at, names = points(game, (16,), torch.float64), ("dynamics", "terminal_value", "constraint", "running_cost")
    for place in game.periodic:
        shift = torch.zeros_like(at.x)
        shift[..., place] = game.state_box.width[:, place]
        moved = methods(game, at._replace(x=at.x + shift))
        for name in names:
            before = methods(game, at)[name][0]()
            gap = float((moved[name][0]() - before).abs().max() / (1 + before.abs().max()))
            expected = f"{name} that repeats after one edge of state_box along the periodic state {place}"
            remedy = "Make the edge one period (2 pi rad), or take the state out of `periodic`."
            require(gap <= 1e-5, expected, f"a relative difference of {gap:.3g}", remedy)


def _check_penalty(game: Game) -> None:
    grid = torch.linspace(-2, 2, 41, dtype=torch.float64)
    steps = game.soft_constraint(grid).diff()
    grows = bool((steps >= 0).all() and steps.sum() > 0)
    require(grows, "a soft_constraint that grows with the constraint", steps.tolist(), "Safe is a constraint below 0.")
    at = points(game, (1024,), torch.float64)
    bad, penalty = game.violates(at.x, at.theta), game.penalty(at.x, at.theta).sum(-1)
    if bool(bad.any() and not bad.all()):
        inside, outside = float(penalty[bad].mean()), float(penalty[~bad].mean())
        expected = "a penalty that is larger where constraints are violated"
        require(
            inside > outside, expected, f"a mean of {inside:.3g} there and of {outside:.3g} elsewhere", "Mind signs."
        )


def _check_starts(game: Game) -> None:
    generator = torch.Generator().manual_seed(0)
    x, theta = game.initial_box.sample(256, generator), game.type_box.sample(256, generator)
    share = float(game.violates(x, theta).double().mean())
    remedy = "A constraint is below 0 where players are safe: turn its sign, or move initial_box."
    require(share < 0.5, "an initial_box where players are mostly safe", f"violations at {share:.0%} of starts", remedy)


def _check_signs(game: Game) -> None:
    """Far away, rewards are low and costs are high; of a game in which the opposite holds for all, a sign is wrong."""
    x, theta = game.state_box.sample(256, torch.Generator().manual_seed(0)), game.type_box.lo.expand(256, -1)
    centre = ((game.state_box.lo + game.state_box.hi) / 2).expand_as(x)
    away = 20 * (x - centre)

    def bend(name: str) -> Tensor:
        values = [methods(game, Point(at, at, at, theta))[name][0]() for at in (centre + away, centre - away, centre)]
        return (values[0] + values[1] - 2 * values[2]).mean(0) / (1e-6 + values[2].abs().amax())

    remedy = "Players maximise V = -J: terminal_value is the reward -g, state_cost a cost."
    grows, falls = bool((bend("terminal_value") > 1e-3).all()), bool((bend("state_cost") < -1e-3).all())
    require(not grows, "a terminal_value that is a reward", "one that grows without bound for all players", remedy)
    require(not falls, "a state_cost that is a cost", "one that falls without bound for all players", remedy)


def _check_potential(game: Game) -> None:
    if game.potential:
        gap = potential_gap(game)
        expected = "a player's deviation to change its own running cost as much as potential_cost"
        got = f"a difference of {gap:.3g} of the cost"
        remedy = "Override potential_cost, with what players share counted once, or set potential = False."
        require(gap <= GAP, expected, got, remedy)


def _warn_of_opposition(game: Game) -> None:
    """Warn of games such as pursuit, in which what one player does for itself harms another directly.

    The search descends on the joint cost, in which opposed rewards cancel. Starting from best replies to each other
    solves more of these games, but not all, and makes every start that fails take seconds.
    """
    x, theta, *_ = (points(game, (64,), torch.float64)[k] for k in (0, 3))
    x = x.requires_grad_()
    reward = game.terminal_value(x) - game.horizon * game.state_cost(x, theta)
    totals = [part.sum() + 0 * x.sum() for part in reward.unbind(-1)]
    slope = torch.stack([torch.autograd.grad(total, x, retain_graph=True)[0] for total in totals])
    own = slope.diagonal(dim1=0, dim2=2).movedim(-1, 1)
    along, size = (slope * own).sum((1, 3)), (slope.norm(dim=-1) * own.norm(dim=-1)).sum(1)
    opposed = (along < -0.5 * size) & (size > 1e-9)
    if bool(opposed.any()):
        warnings.warn(
            f"Players {opposed.nonzero()[0].tolist()} have opposed interests. The solver's search is made for players "
            "who share what couples them: where rows stall or have a large global_gap, they are no equilibria.",
            stacklevel=3,
        )


def _check_fingerprint(game: Game) -> None:
    prints = {game.fingerprint()}
    point = points(game, (2,), torch.float64)
    game.constraint(point.x, point.theta), game.dynamics(point.x, point.u), game.terminal_value(point.x)
    prints |= {game.fingerprint(), copy.deepcopy(game).fingerprint()}
    remedy = "Methods must be pure functions of their arguments: no random numbers, clock or counters."
    require(len(prints) == 1, "one fingerprint for one game", sorted(prints), remedy)
