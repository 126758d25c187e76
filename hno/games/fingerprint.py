"""What tells a game's physics from any other's."""

from __future__ import annotations

import copy
import hashlib
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from hno.games.base import Game


def fingerprint(game: Game) -> str:
    """Hash of a game's boxes and of its functions at fixed points.

    It is taken on the CPU in float64, so that it is the same wherever the game is.
    """
    game = copy.deepcopy(game).cpu().double()
    generator = torch.Generator().manual_seed(0)
    boxes = [game.state_box, game.initial_box, game.control_box, game.type_box]
    x, theta = game.state_box.sample(16, generator), game.type_box.sample(16, generator)
    u = game.control_box.sample(16, generator).reshape(16, -1, game.control_dim).expand(-1, game.players, -1)
    values = [corner for box in boxes for corner in (box.lo, box.hi)]
    values += [game.dynamics(x, u), game.effort(u), game.terminal_value(x), game.constraint(x, theta)]
    values += [game.sensors(theta), game.positions(x), game.soft_constraint(torch.linspace(-2, 2, 9, dtype=x.dtype))]
    optional = (name for name in ("state_cost", "penalty", "potential_cost") if game.overrides(name))
    values += [getattr(game, name)(x, theta) for name in optional]
    digits = [f"{v:.4e}" for tensor in values for v in tensor.flatten().tolist()]
    text = repr((type(game).__name__, game.horizon, game.label_step, game.roles, digits))
    return hashlib.sha256(text.encode()).hexdigest()[:16]
