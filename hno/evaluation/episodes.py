"""A few episodes of every type, small enough to be kept with the results and played back."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hno.control.belief import Believing, all_learning
from hno.data.branches import rotations
from hno.data.certificates import safe
from hno.evaluation.sections import Evaluation
from hno.games import Game
from hno.games.kinematics import separation
from hno.types import Extremal, Points, PotentialField, Trajectory

EPISODES = "episodes.json"
"""Name of their file inside a run's folder."""
FRAMES = 50
"""An episode is kept at about so many times, and where players are closest."""
TURN = 0.5
"""Angle that two players must turn around each other, rad, before it counts which way they do so."""


def episodes(evaluation: Evaluation, found: Extremal, played: Trajectory) -> list[dict[str, Any]]:
    """The worst and the typical episode of one type, among the starts that count.

    Returns:
        JSON content: positions of all players over time, the distance below which it is a collision where the
        constraint is one, the branch of a potential that is played, what is believed of types where players learn, the
        path of the equilibrium from the same start and whether players pass on another side than there, costs. Nothing
        without a start that counts.
    """
    counted = safe(found, evaluation.clearance).nonzero().squeeze(-1)
    if len(counted) == 0:
        return []
    near = played.clearance[counted]
    chosen = {"worst": near.argmin(), "typical": near.argsort()[len(near) // 2]}  # NaN is the smallest
    return [{"kind": kind, **_episode(evaluation, played, found, int(counted[k]))} for kind, k in chosen.items()]


def together(game: Game, kept: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """JSON content of a file of episodes, with what is common to all of them."""
    dimensions = game.positions(game.state_box.lo).shape[-1]
    units = {"players": game.players, "dimensions": dimensions, "constraint_unit": game.constraint_unit}
    return {**units, "episodes": kept}


def _episode(evaluation: Evaluation, played: Trajectory, label: Extremal, row: int) -> dict[str, Any]:
    game, theta = evaluation.game, label.theta[row].to(played.x)
    violation = game.constraint(played.x[row], theta.expand(len(played.t), -1)).flatten(1).amax(-1)
    closest = int(violation.nan_to_num(-math.inf).argmax())
    frames = sorted({*range(0, len(played.t), math.ceil(len(played.t) / FRAMES)), closest})
    t, places = played.t[frames], game.positions(played.x[row, frames])
    apart = separation(places).amin(-1) if game.players > 1 and game.distance_constraints else None
    return {
        "theta": [float(entry) for entry in theta],
        "collided": bool(played.collided[row]),
        "clearance": _rounded(played.clearance[row]),
        "distance": _rounded(played.distance[row]),
        "cost": _rounded(played.cost[row]),
        "label_cost": _rounded(label.cost[row]),
        "t": _rounded(t),
        "positions": _rounded(places),
        "branch": _branches(evaluation, Points(game.horizon - t, played.x[row, frames], theta.expand(len(t), -1))),
        "belief": _belief(evaluation, played, theta, row, frames),
        "other_side": _other_side(game, played.x[row], label.x[row]),
        "radius": None if apart is None else _rounded(violation[frames] + apart),
        "label_positions": _rounded(_at(t, label.t, game.positions(label.x[row].to(places)))),
    }


def _branches(evaluation: Evaluation, points: Points) -> list[int] | None:
    """The branch that is played at each point; None for an operator without branches."""
    field = evaluation.policy.operator.field(points)
    return field.branches.argmax(-1).tolist() if isinstance(field, PotentialField) else None


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
