"""What a network is fed with: times, states as each player sees them, roles, and each type once."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from hno.games import Game
from hno.operators.network import Inputs
from hno.types import Types


class StateFeatures(nn.Module):
    """Scaled states; those that wrap around as sine and cosine.

    Args:
        game: the game.
    """

    def __init__(self, game: Game) -> None:
        super().__init__()
        self.game = [game]  # a list: the operator owns the game, whose buffers must not be saved twice
        self.periodic = list(game.periodic)
        self.features = game.state_dim + len(self.periodic)

    def scaled(self, x: Tensor) -> Tensor:
        """(B, P, n) -> (B, P, features)."""
        (game,) = self.game
        scaled = game.state_box.scale(x)
        if not self.periodic:
            return scaled
        angle = math.pi * scaled[..., self.periodic]
        scaled = scaled.index_copy(-1, torch.tensor(self.periodic, device=x.device), angle.sin())
        return torch.cat([scaled, angle.cos()], -1)

    def time(self, tau: Tensor) -> Tensor:
        """Times to go in [-1, 1]."""
        return 2 * tau / self.game[0].horizon - 1

    def time_slope(self, gradient: Tensor) -> Tensor:
        """Gradient in inputs that begin with the time (..., inputs) -> derivative in time to go, 1/s, (...)."""
        return gradient[..., 0] * (2 / self.game[0].horizon)

    def unscaled(self, slope: Tensor, x: Tensor, size: Tensor) -> Tensor:
        """Gradient in the features (B, Q, P, features) -> `size` times the derivative in states, (B, Q, P, n)."""
        (game,) = self.game
        scaled = slope[..., : game.state_dim]
        if self.periodic:
            angle = math.pi * game.state_box.scale(x)[..., self.periodic].unsqueeze(-3)
            turned = scaled[..., self.periodic] * angle.cos() - slope[..., game.state_dim :] * angle.sin()
            scaled = scaled.index_copy(-1, torch.tensor(self.periodic, device=x.device), math.pi * turned)
        return scaled * (2 * size / game.state_box.width)


class JointEncoding(StateFeatures):
    """Scaled network inputs of all players in their usual order, and the way back for gradients.

    Args:
        game: the game.
        sensors: size of the branch input.
    """

    def __init__(self, game: Game, sensors: int) -> None:
        super().__init__(game)
        self.sizes = Inputs(1 + game.players * self.features, 0, 0, 0, sensors)

    def forward(self, tau: Tensor, x: Tensor) -> Tensor:
        """Trunk inputs, (B,), (B, P, n) -> (B, `Inputs.total`)."""
        return torch.cat([self.time(tau).unsqueeze(-1), self.scaled(x).flatten(-2)], -1)

    def state_slope(self, gradient: Tensor, x: Tensor, size: Tensor) -> Tensor:
        """Gradient in y (B, `Inputs.total`) -> `size` times the derivative in every state, (B, 1, P, n)."""
        return self.unscaled(gradient[..., 1:].unflatten(-1, (1, x.shape[-2], self.features)), x, size)


class Encoding(StateFeatures):
    """Scaled network inputs of every player, itself first, and the way back for gradients.

    Args:
        game: the game.
    """

    roles: Tensor

    def __init__(self, game: Game) -> None:
        super().__init__(game)
        self.register_buffer("roles", torch.tensor(game.roles, dtype=game.state_box.lo.dtype), persistent=False)
        self.has_roles, self.several = len(set(game.roles)) > 1, game.players > 2
        sensors = game.sensors((game.type_box.lo + game.type_box.hi) / 2).shape[-1]
        other = self.features + self.several * (self.has_roles + 1)
        self.sizes = Inputs(1 + self.features, other, game.players - 1, int(self.has_roles), sensors)

    def forward(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """Trunk inputs, (B,), (B, P, n), (B, P) -> (B, P, `Inputs.total`)."""
        (game,) = self.game
        states = self.scaled(x)
        roles = self.roles.to(x).expand(theta.shape).unsqueeze(-1)
        parts = [states, *([roles] if self.has_roles else []), game.type_box.scale(theta).to(x).unsqueeze(-1)]
        others = ego_views(torch.cat(parts, -1) if self.several else states)[..., 1:, :].flatten(-2)
        times = self.time(tau)[..., None, None].expand(*states.shape[:-1], 1)
        return torch.cat([times, states, others, *([roles] if self.has_roles else [])], -1)

    def state_slope(self, gradient: Tensor, x: Tensor, size: Tensor) -> Tensor:
        """Gradient in y (B, P, `Inputs.total`) -> `size` times the derivative in every state, (B, P, P, n)."""
        sizes, own = self.sizes, gradient[..., None, 1 : 1 + self.features]
        others = gradient[..., sizes.ego : sizes.total - sizes.role].unflatten(-1, (sizes.others, sizes.other))
        views = torch.cat([own, others[..., : self.features]], -2)
        return self.unscaled(ego_views(views, inverse=True), x, size)


def ego_views(x: Tensor, *, inverse: bool = False) -> Tensor:
    """Each player's view of a joint quantity, itself first.

    Args:
        x: (B, P, n), or (B, P, P, n) with one copy per player already (needed for the inverse).
        inverse: turn views back into the common order.

    Returns:
        (B, P, P, n); entry [..., i, j, :] is player (i + j) mod P, or its inverse.
    """
    players = x.shape[-2]
    if not inverse:
        return torch.stack([x.roll(-i, -2) for i in range(players)], -3)
    return torch.stack([x[..., i, :, :].roll(i, -2) for i in range(players)], -3)


def distinct_types(theta: Tensor) -> Types:
    """The different types among (B, P) as a table; this waits for the device."""
    distinct, which = theta.reshape(-1, theta.shape[-1]).unique(dim=0, return_inverse=True)
    return Types(distinct, which)
