"""The contract of a game, shipped so that authors of games can check their own."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from hno.games.base import Game, own_costate

COSTATE_SCALES = (1.0, 30.0, 1000.0)  # with optimal controls inside the control box, at its border and far outside


class ContractError(AssertionError):
    """A game breaks the contract; the message says what was expected, what came and what to do."""


class _Point(NamedTuple):
    x: Tensor
    u: Tensor
    costate: Tensor
    theta: Tensor


def check_game(game: Game) -> None:
    """Check everything that the solver, the operators and the losses rely on.

    Args:
        game: any game; it is copied, not changed.

    Raises:
        ContractError: the first promise that the game breaks.
    """
    game = copy.deepcopy(game)
    for check in (_check_box_shapes, _check_box_edges, _check_horizon):
        check(game)
    for dtype in (torch.float32, torch.float64):
        for check_dtype in (_check_outputs, _check_derivatives, _check_control_box):
            check_dtype(game.to(dtype), dtype)
    for check in (_check_fingerprint, _check_decoupled, _check_optimality, _check_roles, _check_penalty):
        check(game)


def _require(met: bool, expected: str, got: object, remedy: str) -> None:
    if not met:
        raise ContractError(f"Expected {expected}; got {got}. {remedy}")


def _points(game: Game, shape: tuple[int, ...], dtype: torch.dtype, scale: float = 30.0, seed: int = 0) -> _Point:
    """Random states of the PDE box, controls, costates of size `scale` and types."""
    generator, size, players = torch.Generator().manual_seed(seed), torch.Size(shape).numel(), game.players
    x = game.state_box.sample(size, generator).unflatten(0, (*shape, 1)).squeeze(len(shape))
    u = game.control_box.sample(size * players, generator).unflatten(0, (*shape, players))
    costate = scale * torch.randn(*shape, players, *x.shape[-2:], generator=generator)
    theta = game.type_box.sample(size, generator).unflatten(0, (*shape, 1)).squeeze(len(shape))
    return _Point(x.to(dtype), u.to(dtype), costate.to(dtype), theta.to(dtype))


def _check_box_shapes(game: Game) -> None:
    joint, own = (game.players, game.state_dim), (game.control_dim,)
    shapes = {"state_box": joint, "initial_box": joint, "control_box": own, "type_box": joint[:1]}
    for name, shape in shapes.items():
        box = getattr(game, name)
        remedy = "Boxes have one row per entry of `roles`, except for control_box: it is that of one player."
        _require(tuple(box.lo.shape) == shape, f"{name} of shape {shape}", tuple(box.lo.shape), remedy)
        finite = bool(box.width.isfinite().all())
        _require(finite, f"finite corners of {name}", [box.lo.tolist(), box.hi.tolist()], "State its limits.")


def _check_box_edges(game: Game) -> None:
    outer, inner = game.state_box, game.initial_box
    for name, box in (("state_box", outer), ("control_box", game.control_box)):
        _require(bool((box.width > 0).all()), f"positive edges of {name}", box.width.tolist(), "They are divided by.")
    inside, corners = bool(outer.contains(inner.lo) & outer.contains(inner.hi)), [inner.lo.tolist(), inner.hi.tolist()]
    _require(inside, "initial_box inside state_box", corners, "Widen state_box until every episode starts in it.")


def _check_horizon(game: Game) -> None:
    steps = game.horizon / game.label_step if game.label_step > 0 else 0.0
    whole = steps > 0.5 and abs(steps - round(steps)) < 1e-6
    got = f"horizon {game.horizon} s, label_step {game.label_step} s"
    _require(whole, "a horizon that is a whole multiple of label_step", got, "Change one of them.")


def _methods(game: Game, at: _Point) -> dict[str, tuple[Callable[[], Tensor], tuple[int, ...]]]:
    """Every method with its arguments, and the shape of its result after the batch shape, up to a free last axis."""
    players, states, controls = game.players, game.state_dim, game.control_dim
    return {
        "dynamics": (lambda: game.dynamics(at.x, at.u), (players, states)),
        "effort": (lambda: game.effort(at.u), (players,)),
        "terminal_value": (lambda: game.terminal_value(at.x), (players,)),
        "constraint": (lambda: game.constraint(at.x, at.theta), (players,)),
        "running_cost": (lambda: game.running_cost(at.x, at.u, at.theta), (players,)),
        "hamiltonian": (lambda: game.hamiltonian(at.x, at.costate, at.u, at.theta), (players,)),
        "best_response": (lambda: game.best_response(at.x, own_costate(at.costate)), (players, controls)),
        "optimal_control": (lambda: game.optimal_control(at.x, at.costate), (players, controls)),
        "violates": (lambda: game.violates(at.x, at.theta), ()),
        "sensors": (lambda: game.sensors(at.theta), (players,)),
        "positions": (lambda: game.positions(at.x), (players,)),
    }


def _check_outputs(game: Game, dtype: torch.dtype) -> None:
    for shape in ((), (2,), (2, 3)):
        for name, (method, tail) in _methods(game, _points(game, shape, dtype)).items():
            output = _call(name, method, shape, dtype)
            last = output.shape[-1] if output.dim() > 0 else 0
            free = {"sensors": (max(1, last),), "positions": (3 if last == 3 else 2,)}.get(name, ())
            _require_output(name, output, (*shape, *tail, *free), torch.bool if name == "violates" else dtype)


def _call(name: str, method: Callable[[], Tensor], shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    try:
        return method()
    except (RuntimeError, TypeError, ValueError, IndexError) as error:
        raise ContractError(
            f"Expected {name} to accept batch shape {shape} in {dtype}; got {type(error).__name__}: {error}. Index the "
            "last axes (x[..., i, :]), and register constant tensors as buffers, so that they follow the game's dtype."
        ) from error


def _require_output(name: str, output: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> None:
    remedy = "Index the last axes (x[..., i, :]) and stack on them; see hno.types for the shapes."
    _require(tuple(output.shape) == shape, f"{name} of shape {shape}", tuple(output.shape), remedy)
    remedy = "Register constant tensors as buffers and build new ones with the dtype of an argument."
    _require(output.dtype == dtype, f"{name} of {dtype} in a game and at points of that kind", output.dtype, remedy)
    finite = bool(output.isfinite().all())
    _require(finite, f"finite {name} in state_box", output.tolist(), "Guard divisions, roots and logarithms.")


def _check_derivatives(game: Game, dtype: torch.dtype) -> None:
    at = _points(game, (4,), dtype)
    centre, still = (((box.lo + box.hi) / 2) for box in (game.state_box, game.control_box))
    places = {
        "in state_box": at,
        "where the players' positions coincide": at._replace(x=_contact(game, at.x)),
        "where the players' states are equal": at._replace(x=at.x[:, :1].expand_as(at.x)),
        "at the centres of the boxes": at._replace(x=centre.expand_as(at.x), u=still.expand_as(at.u)),
    }
    for where, point in places.items():
        inputs = _Point(*(part.detach().clone().requires_grad_() for part in point))
        for name in ("dynamics", "effort", "terminal_value", "constraint", "running_cost", "best_response"):
            _require_smooth(name, _methods(game, inputs)[name][0](), inputs, where)


def _require_smooth(name: str, output: Tensor, inputs: _Point, where: str) -> None:
    remedy = "Round the tips of norms and roots, as hno.games.kinematics.separation does; avoid 0 * inf in branches."
    first = _gradients(output, inputs)
    second = [] if name == "best_response" else [s for f in first for s in _gradients(f, inputs)]
    for order, gradients in (("first", first), ("second", second)):
        finite = all(bool(gradient.isfinite().all()) for gradient in gradients)
        _require(finite, f"finite {order} derivatives of {name} {where}", "NaN or infinity", remedy)


def _gradients(output: Tensor, inputs: _Point) -> list[Tensor]:
    """Gradients of a weighted sum of the entries in every input; none if it is a constant."""
    if not output.requires_grad:
        return []
    weight = torch.linspace(1, 2, output.numel(), dtype=output.dtype).view_as(output)
    return list(torch.autograd.grad((weight * output).sum(), inputs, create_graph=True, materialize_grads=True))


def _contact(game: Game, x: Tensor) -> Tensor:
    """States near `x` (B, P, n) at which all players are at one place, by Newton steps of least norm.

    They are rounded to short binary fractions, so that differences of positions cancel to exactly 0.
    """

    def gaps(state: Tensor) -> Tensor:
        return game.positions(state).diff(dim=-2).flatten()

    states = list((64 * x).round() / 64)
    for _ in range(3):
        inverses = [torch.linalg.pinv(torch.autograd.functional.jacobian(gaps, s).flatten(1)) for s in states]
        moved = [s - (inverse @ gaps(s)).view_as(s) for s, inverse in zip(states, inverses, strict=True)]
        states = [(1024 * s).round() / 1024 for s in moved]
    return torch.stack(states)


def _check_control_box(game: Game, dtype: torch.dtype) -> None:
    for scale in COSTATE_SCALES:
        at = _points(game, (64,), dtype, scale)
        u = game.optimal_control(at.x, at.costate)
        excess = (u - game.control_box.clamp(u)).abs()
        inside = bool((excess <= 8 * torch.finfo(dtype).eps * u.abs()).all())
        _require(inside, "optimal_control inside control_box", f"an excess of {float(excess.max()):.3g}", "Clamp it.")


def _check_optimality(game: Game) -> None:
    for seed, scale in enumerate(COSTATE_SCALES):
        at = _points(game, (256,), torch.float64, scale, seed)
        u = game.optimal_control(at.x, at.costate)
        best = game.hamiltonian(at.x, at.costate, u, at.theta)
        for player, length in itertools.product(range(game.players), (1.0, 0.1, 0.01)):
            other = u.clone()
            other[..., player, :] = u[..., player, :].lerp(at.u[..., player, :], length)
            gain = (game.hamiltonian(at.x, at.costate, other, at.theta) - best)[..., player]
            met = bool((gain <= 1e-10 * (1 + best[..., player].abs())).all())
            expected = f"a Hamiltonian of player {player} that no other control in control_box raises"
            remedy = "best_response must be its exact maximiser; see ControlAffineGame for a closed form."
            _require(met, expected, f"a gain of {float(gain.max()):.3g} at costates of size {scale:g}", remedy)


def _check_decoupled(game: Game) -> None:
    at, moved = (_points(game, (16,), torch.float64, seed=seed) for seed in (0, 1))
    for player in range(game.players):
        mask = torch.arange(game.players) == player
        parts = zip(at, moved, strict=True)
        one_moved = _Point(*(torch.where(mask.view(-1, *(1,) * (a.dim() - 2)), b, a) for a, b in parts))
        for name in ("dynamics", "effort", "best_response"):
            change = (_methods(game, one_moved)[name][0]() - _methods(game, at)[name][0]()).abs()
            others = change.movedim(1, 0)[~mask]
            expected = f"{name} of each player that depends on its own state, control and costate alone"
            got = f"a change of {float(others.amax() if len(others) else 0):.3g} when player {player} moves"
            _require(bool((others <= 1e-9).all()), expected, got, "Couple the players through `constraint`.")


def _check_roles(game: Game) -> None:
    at, box = _points(game, (16,), torch.float64), game.state_box
    names = ("dynamics", "effort", "terminal_value", "constraint", "sensors")
    orders = [list(o) for o in itertools.permutations(range(game.players))]
    for order in (o for o in orders if [game.roles[player] for player in o] == list(game.roles)):
        swapped = at._replace(x=at.x[:, order], u=at.u[:, order], theta=at.theta[:, order])
        pairs = {n: (_methods(game, swapped)[n][0](), _methods(game, at)[n][0]()[:, order]) for n in names}
        pairs["state_box"] = torch.cat([box.lo, box.hi], 1), torch.cat([box.lo, box.hi], 1)[order]
        for name, (after, before) in pairs.items():
            gap = float((after - before).abs().max() / (1 + before.abs().max()))
            expected = f"{name} to swap when players of equal role swap (roles are {game.roles})"
            remedy = f"If these players differ, declare roles = ({', '.join(map(str, range(game.players)))})."
            _require(gap <= 1e-9, expected, f"a relative difference of {gap:.3g}", remedy)


def _check_penalty(game: Game) -> None:
    steps = game.penalty(torch.linspace(-2, 2, 41, dtype=torch.float64)).diff()
    grows = bool((steps >= 0).all() and steps.sum() > 0)
    _require(grows, "a penalty that grows with the constraint", steps.tolist(), "Safe is a constraint below 0.")
    at = _points(game, (256,), torch.float64)
    agree = torch.equal(game.violates(at.x, at.theta), (game.constraint(at.x, at.theta) >= 0).any(-1))
    _require(agree, "violates where a constraint is at least 0", "a disagreement", "Override `constraint` only.")


def _check_fingerprint(game: Game) -> None:
    prints = {game.fingerprint()}
    point = _points(game, (2,), torch.float64)
    game.constraint(point.x, point.theta), game.dynamics(point.x, point.u), game.terminal_value(point.x)
    prints |= {game.fingerprint(), copy.deepcopy(game).fingerprint()}
    remedy = "Methods must be pure functions of their arguments: no random numbers, clock or counters."
    _require(len(prints) == 1, "one fingerprint for one game", sorted(prints), remedy)
