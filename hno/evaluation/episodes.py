"""A few episodes of every type, small enough to be kept with the results and played back."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from hno.control.belief import Believing, all_learning
from hno.data.branches import rotations
from hno.data.certificates import safe
from hno.data.store import replace_whole
from hno.evaluation.sections import Evaluation
from hno.evaluation.starts import key_of
from hno.games import Game
from hno.games.kinematics import separation
from hno.types import Extremal, Points, PotentialField, Trajectory

EPISODES, PATHS = "episodes.json", "episodes.safetensors"
"""Names of their files inside a run's folder: what is drawn, and states, controls and values at every step."""
FRAMES = 50
"""An episode is kept at about so many times, and where players are closest."""
TURN = 0.5
"""Angle that two players must turn around each other, rad, before it counts which way they do so."""


class Kept(NamedTuple):
    """An episode that is kept."""

    row: int
    """Its start, among those of its type."""
    content: dict[str, Any]
    """JSON content, see `episodes`."""
    path: dict[str, Tensor]
    """At every step: t (K,), x (K, P, n), positions p (K, P, d), u (K - 1, P, m), V_i as value (K, P); the same of the
    equilibrium at its nodes, with "label_" before."""


def episodes(evaluation: Evaluation, found: Extremal, played: Trajectory, also: Collection[int] = ()) -> list[Kept]:
    """The worst and the typical episode of one type, among the starts that count, and those of further starts.

    The worst is where most was lost against the equilibrium: a collision, since the equilibrium is safe, and of several
    the one with the largest joint cost above the equilibrium's. Typical is the start whose equilibrium has the median
    cost: the same for every policy that plays these starts.

    Args:
        evaluation: the model.
        found: labels of the starts of one type.
        played: the episodes from there.
        also: rows of further starts to keep, such as those that another model's file has.

    Returns:
        JSON content: positions, controls, speeds and values of all players over time, the distance below which it is a
        collision where the constraint is one, the branch of a potential that is played, what is believed of types where
        players learn, the path of the equilibrium from the same start and whether players pass on another side than
        there, costs. Nothing without a start that counts.
    """
    counted = safe(found, evaluation.clearance).nonzero().squeeze(-1)
    if len(counted) == 0:
        return []
    cost = found.cost[counted].nan_to_num(math.inf)
    lost = (played.cost[counted] - found.cost[counted].to(played.cost)).double().nan_to_num(math.inf, posinf=math.inf)
    order = sorted(range(len(counted)), key=lambda k: (bool(played.collided[counted[k]]), float(lost[k])))
    chosen = {"worst": order[-1], "typical": int(cost.argsort(stable=True)[len(cost) // 2])}
    rows = [(kind, int(counted[k])) for kind, k in chosen.items()]
    rows += [("compared", row) for row in also if row not in dict(rows).values()]
    key = key_of(found.x[:, 0])
    return [_kept(evaluation, played, found, row, {"kind": kind, "start": f"{key}/{row}"}) for kind, row in rows]


def together(game: Game, kept: Sequence[Kept]) -> dict[str, Any]:
    """JSON content of a file of episodes, with what is common to all of them."""
    dimensions, scene = game.positions(game.state_box.lo).shape[-1], game.scene()
    units = {"players": game.players, "dimensions": dimensions, "constraint_unit": game.constraint_unit}
    sizes = {"controls": game.control_dim, "players": game.players}
    names = {kind: scene.named(kind, count) for kind, count in sizes.items()}
    names["states"] = tuple(f"{name} [{unit}]" if unit else name for name, unit in game.named_states())
    drawn = {"bodies": scene.bodies, "roads": [road._asdict() for road in scene.roads], "note": scene.note, **names}
    return {**units, "scene": drawn, "episodes": [one.content for one in kept]}


def write_paths(kept: Sequence[Kept], path: Path) -> None:
    """Write states, controls and values at every step into a safetensors file, `<number of the episode>.<name>`."""
    found = {f"{k}.{name}": tensor.float().cpu() for k, one in enumerate(kept) for name, tensor in one.path.items()}
    replace_whole(path, lambda draft: save_file({name: one.contiguous().clone() for name, one in found.items()}, draft))


def _kept(evaluation: Evaluation, played: Trajectory, label: Extremal, row: int, names: dict[str, str]) -> Kept:
    game, theta = evaluation.game, label.theta[row].to(played.x)
    x, t = played.x[row], played.t
    violation = game.constraint(x, theta.expand(len(t), -1)).flatten(1).amax(-1)
    closest = int(violation.nan_to_num(-math.inf).argmax())
    frames = sorted({*range(0, len(t), math.ceil(len(t) / FRAMES)), closest})
    places = game.positions(x)
    apart = separation(places[frames]).amin(-1) if game.players > 1 and game.distance_constraints else None
    points = Points(game.horizon - t, x, theta.expand(len(t), -1))
    field = evaluation.policy.operator.field(points)
    value = field.players if isinstance(field, PotentialField) else field.value
    numbers = {name: getattr(played, name)[row] for name in ("clearance", "distance", "cost")}
    content = {
        **names,
        "theta": [float(entry) for entry in theta],
        "collided": bool(played.collided[row]),
        **{name: _rounded(number) for name, number in numbers.items()},
        "label_cost": _rounded(label.cost[row]),
        "t": _rounded(t[frames]),
        "positions": _rounded(places[frames]),
        "speed": _rounded(_speed(t, places)[frames]),
        "controls": _rounded(played.u[row][[min(frame, len(t) - 2) for frame in frames]]),
        "value": _rounded(value[frames]),
        "branch": field.branches.argmax(-1)[frames].tolist() if isinstance(field, PotentialField) else None,
        "belief": _belief(evaluation, played, theta, row, frames),
        "other_side": _other_side(game, x, label.x[row]),
        "radius": None if apart is None else _rounded(violation[frames] + apart),
        "label_positions": _rounded(_at(t[frames], label.t, game.positions(label.x[row].to(places)))),
    }
    path = {"t": t, "x": x, "p": places, "u": played.u[row], "value": value.detach()}
    own = {name: getattr(label, name)[row] for name in ("x", "u", "value")}
    own |= {"t": label.t, "p": game.positions(own["x"].to(places))}
    path |= {f"label_{name}": one for name, one in own.items()}
    return Kept(row, content, path)


def _speed(t: Tensor, places: Tensor) -> Tensor:
    """Speeds along positions (K, P, d), m/s, (K, P)."""
    return torch.gradient(places, spacing=(t,), dim=0)[0].norm(dim=-1)


def _belief(evaluation: Evaluation, played: Trajectory, theta: Tensor, row: int, frames: Sequence[int]) -> Any:
    """What the others believe of each player's type, where they learn: mean, and ends of the central 90 %, (F, P, 3).

    Beliefs follow from the motion: they are found again along the path.
    """
    acts, game = evaluation.condition.disturbance.learns, evaluation.game
    if acts is None or game.players == 1:
        return None
    watching, types, dt = all_learning(evaluation.policy, game, acts), theta.unsqueeze(0), evaluation.dt
    x, u = played.x[row].unsqueeze(1), played.u[row].unsqueeze(1)
    watching.reset(x[0], types)
    said = [_said(watching)]
    for k in range(len(u)):
        watching.act(played.t[-1] - played.t[k : k + 1], x[k], types)
        watching.observe(x[k + 1], u[k], dt)
        said.append(_said(watching))
    return _rounded(torch.stack(said)[frames])


def _said(watching: Believing) -> Tensor:
    """Mean, 5 % and 95 % quantile of what the others believe of each type, on average, (P, 3)."""
    players = range(watching.game.players)
    others = [[watching.marginal(i, j)[0] for i in players if i != j] for j in players]
    mixed = torch.stack([torch.stack(own).mean(0) for own in others])
    below = mixed.cumsum(-1)
    ends = [
        watching.grid.gather(1, (below < share).sum(-1, keepdim=True).clamp(max=mixed.shape[1] - 1))
        for share in (0.05, 0.95)
    ]
    return torch.cat([(mixed * watching.grid).sum(-1, keepdim=True), *ends], -1)


def _other_side(game: Game, played: Tensor, label: Tensor) -> bool:
    """Whether two players turn around each other another way than along the label, (K, P, n) and (L, P, n)."""
    if game.players == 1:
        return False
    own, other = (rotations(game, x.double().cpu().unsqueeze(0)) for x in (played, label))
    turned = torch.minimum(own.norm(dim=-1), other.norm(dim=-1)) > TURN
    return bool((turned & ((own * other).sum(-1) < 0)).any())


def _at(times: Tensor, t: Tensor, places: Tensor) -> Tensor:
    """Positions (K, P, d) at nodes t, interpolated to other times."""
    columns = [np.interp(times.cpu(), t.cpu(), column) for column in places.flatten(1).cpu().mT]
    return torch.from_numpy(np.stack(columns, -1)).unflatten(-1, places.shape[1:])


def _rounded(values: Tensor) -> Any:
    """Numbers with three decimals, nested as the tensor is."""
    return np.round(values.double().cpu().numpy(), 3).tolist()
