"""The contract of a game, shipped so that authors of games can check their own."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from hno.games.affine import ControlAffineGame
from hno.games.base import REQUIRED, Game
from hno.games.physics_checks import (
    AFFINE,
    METHODS,
    ContractError,
    Point,
    call,
    check_control_box,
    check_physics,
    points,
    require,
)

__all__ = ["ContractError", "check_game"]


def check_game(game: Game) -> None:
    """Check everything that the solver, the operators and the losses rely on.

    Args:
        game: any game; it is copied, not changed.

    Raises:
        ContractError: the first promise that the game breaks.
    """
    game = copy.deepcopy(game)
    for check in (_check_attributes, _check_boxes, _check_places):
        check(game)
    for dtype in (torch.float32, torch.float64):
        for check_dtype in (_check_outputs, _check_derivatives, check_control_box):
            check_dtype(game.to(dtype), dtype)
    check_physics(game)
    _check_rows(game)
    _check_gradients(game)


def _check_attributes(game: Game) -> None:
    for name in REQUIRED:
        require(hasattr(game, name), f"an attribute {name}", "none", "Set it in the constructor, see hno.games.Game.")
    try:
        game.check_constants()
    except ValueError as error:
        raise ContractError(f"Expected positive constants; got: {error} Change it.") from error


def _check_boxes(game: Game) -> None:
    remedy = "Boxes have one row per entry of `roles`; control_box may be that of one player, if all have the same."
    joint, own = (game.players, game.state_dim), (game.players, game.control_dim)
    controls = own[1:] if game.control_box.lo.dim() == 1 else own
    shapes = {"state_box": joint, "initial_box": joint, "control_box": controls, "type_box": joint[:1]}
    for name, shape in shapes.items():
        box = getattr(game, name)
        require(box.lo.shape == shape, f"{name} of shape {shape}", tuple(box.lo.shape), remedy)
        corners, positive = [box.lo.tolist(), box.hi.tolist()], (box.width > 0).all() or name == "initial_box"
        require(box.width.isfinite().all(), f"finite corners of {name}", corners, "State its limits.")
        require(positive, f"positive edges of {name}", box.width.tolist(), "They are divided by.")
    start = torch.stack([game.initial_box.lo, game.initial_box.hi])
    inside, remedy = game.state_box.contains(start).all(), "Widen state_box until every episode starts in it."
    require(inside, "initial_box inside state_box", start.tolist(), remedy)


def _check_places(game: Game) -> None:
    steps = game.horizon / game.label_step if game.label_step > 0 else 0.0
    whole, got = abs(steps - round(steps)) < 1e-6, f"horizon {game.horizon} s, label_step {game.label_step} s"
    require(whole and steps > 0.5, "a horizon that is a whole multiple of label_step", got, "Change one of them.")
    known, places = all(place in range(game.state_dim) for place in game.periodic), f"0 to {game.state_dim - 1}"
    require(known, f"places {places} in `periodic`", game.periodic, "They are places in a player's own state.")


def _check_outputs(game: Game, dtype: torch.dtype) -> None:
    for shape in ((), (game.players + 1,), (game.players + 1, game.players + 2)):  # as many rows as players would hide
        at = points(game, shape, dtype)
        for name in _stated(game):
            try:
                output = call(game, name, at)
            except (RuntimeError, TypeError, ValueError, IndexError) as error:
                raise ContractError(
                    f"Expected {name} to accept batch shape {shape} in {dtype}; got {type(error).__name__}: {error}. "
                    "Index the last axes (x[..., i, :]), and register constant tensors as buffers, so that they follow "
                    "the game's dtype."
                ) from error
            _require_output(game, name, output, shape, dtype)


def _stated(game: Game) -> list[str]:
    return [*METHODS, *(AFFINE if isinstance(game, ControlAffineGame) else ())]


def _check_rows(game: Game) -> None:
    """Every row of a batch is answered by itself, in float64."""
    at = points(game, (game.players + 1,), torch.float64)
    for name in METHODS:
        whole = call(game, name, at)
        each = torch.stack([call(game, name, Point(*(part[row] for part in at))) for row in range(len(whole))])
        gap = float((whole - each).abs().max() / (1 + whole.abs().max()))
        remedy = "Index the last axes (x[..., i, :]): the first ones are the batch."
        require(gap <= 1e-9, f"{name} to answer each row of a batch as if alone", f"{gap:.3g} off", remedy)


def _check_gradients(game: Game) -> None:
    """Derivatives in states, controls and costates are those of central differences along one direction, in float64."""
    at, to = (points(game, (64,), torch.float64, seed=seed) for seed in (0, 1))
    way = Point(*(end - start for start, end in zip(at, to, strict=True)))._replace(theta=0 * at.theta)
    remedy = "No detach, item or numpy in a game; a backward of your own must be the derivative of its forward."
    for name in (name for name in METHODS if name != "sensors"):
        ends = [Point(*(start + step * part for start, part in zip(at, way, strict=True))) for step in (1e-6, -1e-6)]
        after, before = (call(game, name, end) for end in ends)
        weight = torch.linspace(1, 2, after.numel(), dtype=after.dtype).view_as(after)
        measured = (weight * (after - before)).reshape(len(after), -1).sum(1) / 2e-6
        inputs = Point(*(part.clone().requires_grad_() for part in at))
        slopes = zip(_gradients(call(game, name, inputs), inputs), way, strict=False)  # none of a constant
        stated = sum(((slope * part).flatten(1).sum(1) for slope, part in slopes), torch.zeros_like(measured))
        wrong = (stated - measured).abs() > 1e-4 * measured.abs() + 1e-6 * (measured.abs().max() + after.abs().max())
        got = f"{stated[wrong][:1].tolist()} for {measured[wrong][:1].tolist()}"
        require(not bool(wrong.any()), f"derivatives of {name} that are those of its values", got, remedy)


def _require_output(game: Game, name: str, output: Tensor, batch: tuple[int, ...], dtype: torch.dtype) -> None:
    last = output.shape[-1] if output.dim() > 0 else 0
    some = (max(1, last),)
    free = {"sensors": some, "constraint": some, "positions": (3 if last == 3 else 2,)}.get(name, ())
    shape = (*batch, *(getattr(game, size) for size in (METHODS | AFFINE)[name][1].split()), *free)
    remedy = "Index the last axes (x[..., i, :]) and stack on them; see hno.types for the shapes."
    require(output.shape == shape, f"{name} of shape {shape}", tuple(output.shape), remedy)
    remedy = "Register constant tensors as buffers and build new ones with the dtype of an argument."
    require(output.dtype == dtype, f"{name} of {dtype} in a game and at points of that kind", output.dtype, remedy)
    remedy = "Guard divisions, roots and logarithms."
    require(output.isfinite().all(), f"finite {name} in state_box", output.tolist(), remedy)


def _check_derivatives(game: Game, dtype: torch.dtype) -> None:
    at = points(game, (4,), dtype)
    centre, still = ((box.lo + box.hi) / 2 for box in (game.state_box, game.control_box))
    places = {
        "in state_box": at,
        "where the players' positions coincide": at._replace(x=_contact(game, at.x)),
        "where the players' states are equal": at._replace(x=at.x[:, :1].expand_as(at.x)),
        "at the centres of the boxes": at._replace(x=centre.expand_as(at.x), u=still.expand_as(at.u)),
    }
    remedy = "Round the tips of norms and roots, as hno.games.kinematics.distances does; avoid 0 * inf in branches."
    for where, point in places.items():
        inputs = Point(*(part.detach().clone().requires_grad_() for part in point))
        for name in (name for name in METHODS if name not in ("sensors", "positions")):
            first = _gradients(call(game, name, inputs), inputs)
            second = [] if name == "best_response" else [s for f in first for s in _gradients(f, inputs)]
            for order, gradients in (("first", first), ("second", second)):
                finite = all(bool(gradient.isfinite().all()) for gradient in gradients)
                require(finite, f"finite {order} derivatives of {name} {where}", "NaN or infinity", remedy)


def _gradients(output: Tensor, inputs: Point) -> list[Tensor]:
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

    def step(state: Tensor) -> Tensor:
        slope = torch.autograd.functional.jacobian(gaps, state).flatten(1)
        return state - (torch.linalg.pinv(slope) @ gaps(state)).view_as(state)

    states = list((64 * x).round() / 64)
    for _ in range(3 if game.players > 1 else 0):
        states = [(1024 * step(state)).round() / 1024 for state in states]
    return torch.stack(states)
