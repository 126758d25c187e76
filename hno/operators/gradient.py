"""The operator of the paper: values from one network that sees the game ego-first, costates from its gradient."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import final

import torch
from torch import Tensor

from hno.games import Game
from hno.operators.base import FieldFunction, ValueOperator, at_fixed_points, functions
from hno.operators.inputs import Encoding, distinct_types
from hno.operators.network import Ensemble, Inputs, Network, median
from hno.pontryagin.adjoint import terminal_costate
from hno.types import Field, Points, Types


@final
@functions.register("value")
class GradientOperator(ValueOperator):
    """One value per player from one network; derivatives are the network's own.

    Args:
        game: the game.
        network: builds one network for the sizes of its inputs.
        exact_terminal: V = -g + (tau / horizon) N rather than N, so that the boundary condition holds exactly.
        members: of the ensemble of networks.

    Raises:
        ValueError: see `Ensemble`.
    """

    def __init__(
        self, game: Game, network: Callable[[Inputs], Network], exact_terminal: bool = True, members: int = 1
    ) -> None:
        super().__init__(game)
        self.meets_terminal = exact_terminal
        self.encoding = Encoding(game)
        self.networks = Ensemble(lambda: network(self.encoding.sizes), members)

    def compile_kernels(self) -> None:
        """Train through `torch.compile`."""
        self.networks.compile_kernels()

    def value(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """The median of the members' values, (B, P)."""
        return self.member_values(tau, x, theta).median(0).values

    def member_values(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """Every member's values, (B,), (B, P, n), (B, P) -> (members, B, P)."""
        y = self.encoding(tau, x, theta).flatten(0, -2)
        sensors, which = self.game.sensors(theta).flatten(0, -2), torch.arange(len(y), device=y.device)
        raw = torch.stack([network(y, sensors, which) for network in self.networks]) * self.value_scale
        raw = raw.view(-1, *theta.shape)
        if not self.meets_terminal:
            return raw
        return self.game.terminal_value(x) + (tau / self.game.horizon).unsqueeze(-1) * raw

    def value_and_costate(self, tau: Tensor, x: Tensor, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Values (P,) and costates (P, P, n) of one state: medians over the members, entry by entry."""

        def values(x: Tensor) -> tuple[Tensor, Tensor]:
            found = self.member_values(tau.unsqueeze(0), x.unsqueeze(0), theta.unsqueeze(0)).squeeze(1)
            return found, found

        costate, value = self.jacobian(values, has_aux=True)(x)
        return value.median(0).values, costate.median(0).values

    def field(self, points: Points, types: Types | None = None) -> Field:
        """Value, time derivative and every costate of all players: medians over the members, entry by entry."""
        types = types or distinct_types(points.theta)
        found = [self._member(network, points, types) for network in self.networks.networks]
        return Field(*map(median, zip(*found, strict=True)))

    @property
    def members(self) -> Sequence[FieldFunction]:
        """The field of every network."""
        return [functools.partial(self._member, network) for network in self.networks.networks]

    def _member(self, network: Network, points: Points, types: Types | None = None) -> Field:
        """The field of one network."""
        tau, x, theta = points
        y = self.encoding(tau, x, theta).flatten(0, -2)
        raw, gradient = network.value_gradient(y, *self._branch(types or distinct_types(theta)))
        gradient = gradient.view(*theta.shape, gradient.shape[-1])
        value, slope = raw.view_as(theta) * self.value_scale, self.encoding.time_slope(gradient) * self.value_scale
        costate = self.encoding.state_slope(gradient, x, self.value_scale)
        if not self.meets_terminal:
            return at_fixed_points(Field(value, slope, costate), points)
        share = (tau / self.game.horizon).unsqueeze(-1)
        slope = value / self.game.horizon + share * slope
        with torch.inference_mode(mode=False):
            end = self.game.terminal_value(x), terminal_costate(self.game, x.clone())
        found = Field(end[0] + share * value, slope, end[1] + share[..., None, None] * costate)
        return at_fixed_points(found, points)

    def _branch(self, types: Types) -> tuple[Tensor, Tensor]:
        """Distinct branch inputs (C P, S), and which of them each row of the trunk takes, (B P,)."""
        players = self.game.players
        which = types.which.reshape(-1, 1) * players + torch.arange(players, device=types.which.device)
        return self.game.sensors(types.distinct).flatten(0, 1), which.flatten()
