"""Checks of what a game means, and what all checks share: where they look, what they call, how they complain."""

from __future__ import annotations

import copy
import itertools
import warnings
from typing import NamedTuple

import torch
from torch import Tensor

from hno.games.base import Game, own_costate
from hno.games.potential import GAP, potential_gap

PERIODIC = ("dynamics", "terminal_value", "constraint", "state_cost", "penalty")
COSTATE_SCALES = (1.0, 30.0, 1000.0)  # with optimal controls inside the control box, at its border and far outside
DECOUPLED = (
    "Coupled dynamics are outside the contract: the solver integrates the adjoints of each player's own states alone, "
    "and its search relies on a joint cost whose stationary points are then equilibria. Couple the players through "
    "`constraint`, `penalty` or `state_cost`."
)
METHODS = {
    "dynamics": ("x u", "players state_dim"),
    "effort": ("u", "players"),
    "terminal_value": ("x", "players"),
    "constraint": ("x theta", "players"),
    "state_cost": ("x theta", "players"),
    "penalty": ("x theta", "players"),
    "potential_cost": ("x theta", ""),
    "best_response": ("x own_costate", "players control_dim"),
    "sensors": ("theta", "players"),
    "positions": ("x", "players"),
}
"""What a game may state: arguments, and the shape of the result after the batch shape, up to a free last axis."""
AFFINE = {"drift": ("x", "players state_dim"), "affine_input": ("u", "players control_dim")}
"""What a `ControlAffineGame` may state besides: a wrong shape would be broadcast in its dynamics."""


class ContractError(AssertionError):
    """A game breaks the contract; the message says what was expected, what came and what to do."""


class Point(NamedTuple):
    """Arguments of a game's methods."""

    x: Tensor
    u: Tensor
    costate: Tensor
    theta: Tensor

    @property
    def own_costate(self) -> Tensor:
        """Each player's costate of its own state."""
        return own_costate(self.costate)


def require(met: bool | Tensor, expected: str, got: object, remedy: str) -> None:
    """Raise unless a promise is kept."""
    if not met:
        raise ContractError(f"Expected {expected}; got {got}. {remedy}")


def points(game: Game, shape: tuple[int, ...], dtype: torch.dtype, scale: float = 30.0, seed: int = 0) -> Point:
    """Random states of the PDE box, controls, costates of size `scale` and types, of a batch shape."""
    generator, size = torch.Generator().manual_seed(seed), torch.Size(shape).numel()
    x, box = game.state_box.sample(size, generator), game.control_box
    u = box.lo + box.width * torch.rand(size, game.players, game.control_dim, generator=generator)
    costate = scale * torch.randn(size, game.players, *x.shape[-2:], generator=generator)
    theta = game.type_box.sample(size, generator)
    return Point(*(part.unflatten(0, (*shape, 1)).squeeze(len(shape)).to(dtype) for part in (x, u, costate, theta)))


def call(game: Game, name: str, at: Point) -> Tensor:
    """What one of `METHODS` or `AFFINE` answers."""
    arguments, _ = (METHODS | AFFINE)[name]
    answer: Tensor = getattr(game, name)(*(getattr(at, argument) for argument in arguments.split()))
    return answer


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
        u = call(game, "best_response", points(game, (64,), dtype, scale))
        excess = (u - game.control_box.clamp(u)).abs()
        inside = (excess <= 8 * torch.finfo(dtype).eps * u.abs()).all()
        require(inside, "optimal_control inside control_box", f"an excess of {float(excess.max()):.3g}", "Clamp it.")


def _require_equal(after: Tensor, before: Tensor, tolerance: float, expected: str, remedy: str) -> None:
    gap = float((after - before).abs().max() / (1 + before.abs().max()))
    require(gap <= tolerance, expected, f"a relative difference of {gap:.3g}", remedy)


def _check_optimality(game: Game) -> None:
    remedy = "best_response must be its exact maximiser; see ControlAffineGame for a closed form."
    for seed, scale in enumerate(COSTATE_SCALES):
        at = points(game, (256,), torch.float64, scale, seed)
        u = call(game, "best_response", at)
        best = game.hamiltonian(at.x, at.costate, u, at.theta)
        for player, length in itertools.product(range(game.players), (1.0, 0.1, 0.01)):
            other = u.clone()
            other[..., player, :] = u[..., player, :].lerp(at.u[..., player, :], length)
            gain = (game.hamiltonian(at.x, at.costate, other, at.theta) - best)[..., player]
            met = (gain <= 1e-10 * (1 + best[..., player].abs())).all()
            expected = f"a Hamiltonian of player {player} that no other control in control_box raises"
            require(met, expected, f"a gain of {float(gain.max()):.3g} at costates of size {scale:g}", remedy)


def _check_decoupled(game: Game) -> None:
    at, moved = (points(game, (16,), torch.float64, seed=seed) for seed in (0, 1))
    for player in range(game.players):
        mask = torch.arange(game.players) == player
        parts = zip(at, moved, strict=True)
        one_moved = Point(*(torch.where(mask.view(-1, *(1,) * (a.dim() - 2)), b, a) for a, b in parts))
        for name in ("dynamics", "effort", "best_response"):
            others = (call(game, name, one_moved) - call(game, name, at)).abs()[:, ~mask]
            expected = f"{name} of each player that depends on its own state, control and costate alone"
            got = f"a change of {float(others.amax()) if others.numel() else 0:.3g} when player {player} moves"
            require((others <= 1e-9).all(), expected, got, DECOUPLED)


def _check_roles(game: Game) -> None:
    at = points(game, (16,), torch.float64)
    names = ("dynamics", "effort", "terminal_value", "constraint", "state_cost", "penalty", "sensors")
    remedy = f"If these players differ, declare roles = ({', '.join(map(str, range(game.players)))})."
    orders = map(list, itertools.permutations(range(game.players)))
    for order in (o for o in orders if [game.roles[player] for player in o] == list(game.roles)):
        swapped = Point(at.x[:, order], at.u[:, order], at.costate, at.theta[:, order])
        pairs = {name: (call(game, name, swapped), call(game, name, at)[:, order]) for name in names}
        after, before = pairs["constraint"]
        pairs["constraint"] = after.sort().values, before.sort().values  # in no particular order
        for name in ("state_box", "initial_box", "control_box"):
            corners = torch.stack([getattr(game, name).lo, getattr(game, name).hi])
            corners = corners.reshape(2, -1, corners.shape[-1]).expand(2, game.players, -1)
            pairs[name] = corners, corners[:, order]
        for name, pair in pairs.items():
            _require_equal(
                *pair, 1e-9, f"{name} to swap when players of equal role swap (roles are {game.roles})", remedy
            )


def _check_periodic(game: Game) -> None:
    at, remedy = (
        points(game, (16,), torch.float64),
        "Make the edge one period (2 pi rad), or take it out of `periodic`.",
    )
    for place, name in itertools.product(game.periodic, PERIODIC):
        shift = torch.zeros_like(at.x)
        shift[..., place] = game.state_box.width[:, place]
        expected = f"{name} that repeats after one edge of state_box along the periodic state {place}"
        _require_equal(call(game, name, at._replace(x=at.x + shift)), call(game, name, at), 1e-5, expected, remedy)


def _check_penalty(game: Game) -> None:
    steps = game.soft_constraint(torch.linspace(-2, 2, 41, dtype=torch.float64)).diff()
    grows = bool((steps >= 0).all() and steps.sum() > 0)
    require(grows, "a soft_constraint that grows with the constraint", steps.tolist(), "Safe is a constraint below 0.")
    at = points(game, (1024,), torch.float64)
    bad, penalty = game.violates(at.x, at.theta), call(game, "penalty", at).sum(-1)
    if bool(bad.any() and not bad.all()):
        inside, outside = float(penalty[bad].mean()), float(penalty[~bad].mean())
        got = f"a mean of {inside:.3g} there and of {outside:.3g} elsewhere"
        require(inside > outside, "a penalty that is larger where constraints are violated", got, "Mind signs.")


def _check_starts(game: Game) -> None:
    generator = torch.Generator().manual_seed(0)
    x, theta = game.initial_box.sample(256, generator), game.type_box.sample(256, generator)
    share = float(game.violates(x, theta).double().mean())
    remedy = "A constraint is below 0 where players are safe: turn its sign, or move initial_box."
    require(share < 0.5, "an initial_box where players are mostly safe", f"violations at {share:.0%} of starts", remedy)


def _check_signs(game: Game) -> None:
    """A reward that grows with the square of the distance in every direction, for all players, is a cost.

    One that grows with the distance itself may be meant, such as that for the way travelled: effort grows faster.
    """
    at = points(game, (256,), torch.float64)
    centre = ((game.state_box.lo + game.state_box.hi) / 2).expand_as(at.x)
    away, theta = at.x - centre, game.type_box.lo.expand_as(at.theta)

    def growth(name: str, widths: float) -> Tensor:
        """Above the centre, so far away on both sides of it, for each player."""
        places = (centre + widths * away, centre - widths * away, centre)
        one, other, middle = (call(game, name, at._replace(x=x, theta=theta)) for x in places)
        return (one + other - 2 * middle).mean(0) / (1e-6 + middle.abs().amax())

    remedy = "Players maximise V = -J: terminal_value is the reward -g, state_cost a cost."
    for name, sign, kind in (("terminal_value", 1, "a reward"), ("state_cost", -1, "a cost")):
        near, far = (sign * growth(name, widths) for widths in (20.0, 40.0))
        got = f"one that {'grows' if sign > 0 else 'falls'} without bound for all players"
        if bool((near > 1e-3).all()):
            require(not bool((far > 3 * near).all()), f"a {name} that is {kind}", got, remedy)  # 4 for squares
            warnings.warn(f"{name} is {got}. {remedy} If that is meant, all is well.", stacklevel=3)


def _check_potential(game: Game) -> None:
    if game.potential:
        gap = potential_gap(game)
        expected = "a player's deviation to change its own cost as much as the potential"
        got = f"a difference of {gap:.3g} of the cost"
        remedy = (
            "Override potential_cost, with what players share counted once, and let no terminal_value depend on other "
            "players, or set potential = False."
        )
        require(gap <= GAP, expected, got, remedy)


def _warn_of_opposition(game: Game) -> None:
    """Warn of games such as pursuit, in which what one player does for itself harms another directly.

    The search descends on the joint cost, in which opposed rewards cancel. Starting from best replies to each other
    solves more of these games, but not all, and makes every start that fails take seconds.
    """
    at = points(game, (64,), torch.float64)
    x = at.x.requires_grad_()
    reward = call(game, "terminal_value", at) - game.horizon * call(game, "state_cost", at)
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
    prints, at = {game.fingerprint()}, points(game, (2,), torch.float64)
    for name in ("constraint", "dynamics", "terminal_value"):
        call(game, name, at)
    prints |= {game.fingerprint(), copy.deepcopy(game).fingerprint()}
    remedy = "Methods must be pure functions of their arguments: no random numbers, clock or counters."
    require(len(prints) == 1, "one fingerprint for one game", sorted(prints), remedy)
