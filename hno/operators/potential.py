"""The operator of a potential game: one function W for all players, the largest of several smooth branches."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import final

import torch
from torch import Tensor

from hno.games import Game
from hno.operators.base import FieldFunction, ValueOperator, at_fixed_points, functions
from hno.operators.inputs import JointEncoding, distinct_types
from hno.operators.network import Ensemble, Inputs, Network, median
from hno.types import Points, PotentialField, Types

MOST = 64
"""Branches that an operator may have; each costs one more product for every row."""


@final
@functions.register("potential")
class PotentialOperator(ValueOperator):
    """The potential W of all players, and every player's value V_i; controls follow from dW / dx_i alone.

    Where the cheapest equilibrium changes from one way around each other to another, W has a ridge. It is the maximum
    of branches, one for each combination of sides on which pairs of players pass (`hno.data.branches`), and each branch
    is smooth. One network gives all of them: its branch input is the game's sensors, the sides, and which of W and V_i
    it is.

    Args:
        game: a potential game.
        network: builds one network for the sizes of its inputs.
        exact_terminal: W = sum of terminal values + (tau / horizon) N rather than N, so that the boundary condition
            holds exactly; V_i likewise.
        members: of the ensemble of networks. The branch that is played is that of the median of W.

    Raises:
        ValueError: the game is no potential game, or has too many combinations of sides; or see `Ensemble`.
    """

    potential = True
    sides: Tensor
    """Side of every pair in every branch, -1 or 1, (K, pairs)."""
    active: Tensor
    """Whether a label has the branch, (K,)."""

    def __init__(
        self, game: Game, network: Callable[[Inputs], Network], exact_terminal: bool = True, members: int = 1
    ) -> None:
        super().__init__(game)
        pairs = game.players * (game.players - 1) // 2
        if 2**pairs > MOST:
            raise ValueError(
                f"{game.players} players have {2**pairs} combinations of sides, more than the {MOST} branches that an "
                "operator may have. Learn the players' values instead (function=value)."
            )
        self.meets_terminal = exact_terminal
        # bit k of a branch's number is the side of pair k
        sides = torch.tensor(list(itertools.product((-1.0, 1.0), repeat=pairs))).view(2**pairs, pairs).flip(-1)
        self.register_buffer("sides", sides, persistent=False)
        self.register_buffer("active", torch.ones(len(sides), dtype=torch.bool))
        size = self._sensors((game.type_box.lo + game.type_box.hi).unsqueeze(0) / 2).shape[-1]
        self.encoding = JointEncoding(game, size)
        self.networks = Ensemble(lambda: network(self.encoding.sizes), members)

    def compile_kernels(self) -> None:
        """Train through `torch.compile`."""
        self.networks.compile_kernels()

    def set_branches(self, branch: Tensor) -> None:
        """Play those branches only that labels have."""
        self.active.zero_()[branch.unique()] = True

    def value(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """V_i of the branch that is played, (B, P)."""
        branches, players = self._functions(tau, x, theta, self._heads(tau, x, theta).median(0).values)
        return _chosen(players, branches.argmax(-1))

    def value_and_costate(self, tau: Tensor, x: Tensor, theta: Tensor) -> tuple[Tensor, Tensor]:
        """V_i (P,) and dW / dx_j (1, P, n) of one state."""

        def functions(x: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
            at = tau.unsqueeze(0), x.unsqueeze(0), theta.unsqueeze(0)
            branches, players = self._functions(*at, self._heads(*at))
            return branches.squeeze(1), (branches.squeeze(1), players.squeeze(1))

        slopes, (branches, players) = self.jacobian(functions, has_aux=True)(x)
        best = branches.median(0).values.argmax(-1)
        return _chosen(players.median(0).values, best), _chosen(slopes.median(0).values, best).unsqueeze(0)

    def field(self, points: Points, types: Types | None = None) -> PotentialField:
        """W, its derivatives and V_i, of the branch in `types` or the best one: medians over the members."""
        return self._field(self.networks.networks, points, types)

    @property
    def members(self) -> Sequence[FieldFunction]:
        """The field of every network."""
        return [functools.partial(self._field, [network]) for network in self.networks.networks]

    def _field(self, networks: Sequence[Network], points: Points, types: Types | None = None) -> PotentialField:
        """The field of the median of some networks."""
        tau, x, theta = points
        types = types or distinct_types(theta)
        y, sensors = self.encoding(tau, x), self._sensors(types.distinct)
        kinds = 1 + self.game.players
        first = types.which.unsqueeze(-1) * (len(self.sides) * kinds)
        which = first + torch.arange(len(self.sides) * kinds, device=y.device)
        heads = median([network.values(y, sensors, which) for network in networks])
        branches, players = self._functions(tau, x, theta, heads)
        branch = branches.argmax(-1)
        if types.branch is not None:
            branch = torch.where(types.branch < 0, branch, types.branch)
        chosen = first.squeeze(-1) + branch * kinds
        found = [self._derivatives(points, *network.value_gradient(y, sensors, chosen)) for network in networks]
        value, slope, costate = map(median, zip(*found, strict=True))
        if self.meets_terminal:
            with torch.inference_mode(mode=False), torch.enable_grad():
                at = x.detach().clone().requires_grad_()
                end = self.game.terminal_value(at).sum(-1)
                (push,) = torch.autograd.grad(end.sum(), at)
            value, costate = end.detach() + value, push.unsqueeze(-3) + costate
        result = PotentialField(value.unsqueeze(-1), slope.unsqueeze(-1), costate, _chosen(players, branch), branches)
        return at_fixed_points(result, points)

    def _derivatives(self, points: Points, raw: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Value, time derivative and costates of what a network adds to the terminal values."""
        tau, x, _ = points
        value, slope = raw * self.value_scale, self.encoding.time_slope(gradient) * self.value_scale
        costate = self.encoding.state_slope(gradient, x, self.value_scale)
        if not self.meets_terminal:
            return value, slope, costate
        share = tau / self.game.horizon
        return share * value, value / self.game.horizon + share * slope, share[..., None, None, None] * costate

    def _heads(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """Raw outputs of every network, (members, B, K (1 + P)), by a pure function."""
        y = self.encoding(tau, x)
        columns = len(self.sides) * (1 + self.game.players)
        which = torch.arange(len(y) * columns, device=y.device).view(len(y), columns)
        sensors = self._sensors(theta)
        return torch.stack([network.values(y, sensors, which) for network in self.networks.networks])

    def _functions(self, tau: Tensor, x: Tensor, theta: Tensor, heads: Tensor) -> tuple[Tensor, Tensor]:
        """W (B, K), -inf for branches without labels, and V_i (B, K, P) of every branch, from the network's outputs."""
        found = heads.unflatten(-1, (len(self.sides), -1)) * self.value_scale
        if self.meets_terminal:
            rewards = self.game.terminal_value(x)
            end = torch.cat([rewards.sum(-1, keepdim=True), rewards], -1).unsqueeze(-2)
            found = end + (tau / self.game.horizon)[..., None, None] * found
        return found[..., 0].masked_fill(~self.active, -torch.inf), found[..., 1:]

    def _sensors(self, theta: Tensor) -> Tensor:
        """Branch inputs of every type, branch and function, the last running fastest, (C, P) -> (C K (1 + P), S)."""
        game, kinds = self.game, 1 + self.game.players
        each = game.sensors(theta).flatten(-2)[:, None, None]
        sides, kind = self.sides.to(each)[:, None], torch.eye(kinds, dtype=each.dtype, device=each.device)
        size = len(theta), len(self.sides), kinds
        return torch.cat([each.expand(*size, -1), sides.expand(*size, -1), kind.expand(*size, -1)], -1).flatten(0, 2)


def _chosen(table: Tensor, which: Tensor) -> Tensor:
    """The entry of each row, (B, K, ...) and (B,) -> (B, ...), or (K, ...) and () -> (...)."""
    index = which[(..., *(None,) * (table.dim() - which.dim()))]
    return table.take_along_dim(index, which.dim()).squeeze(which.dim())
