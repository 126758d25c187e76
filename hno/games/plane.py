"""Coordinates of a joint state by name, and the plane that pictures of a game show first."""

from __future__ import annotations

import copy
import difflib
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar, NamedTuple, cast

import torch
from torch import Tensor

if TYPE_CHECKING:
    from hno.games.base import Game


class Axis(NamedTuple):
    """A coordinate and the part of it that is shown."""

    name: str
    lo: float | None = None
    """None for the edge of the PDE box."""
    hi: float | None = None


class Plane(NamedTuple):
    """Two coordinates, and values of others; what is not named is as in the base state."""

    across: Axis
    up: Axis
    at: Mapping[str, float] = MappingProxyType({})


class Coordinate(NamedTuple):
    """A linear function of the joint state, <weights, x> + offset."""

    name: str
    unit: str
    weights: Tensor
    """(P, n), float64."""
    offset: float
    lo: float
    """Its smallest value in the PDE box."""
    hi: float
    """Its largest one."""

    def of(self, x: Tensor) -> Tensor:
        """Its value at joint states, (..., P, n) -> (...)."""
        return (self.weights * x).sum((-1, -2)) + self.offset

    def put(self, x: Tensor, value: Tensor | float) -> Tensor:
        """The nearest joint states at which it has a value, (..., P, n)."""
        missing = (value - self.of(x)) / self.weights.square().sum()
        return x + missing[..., None, None] * self.weights


class Coordinates:
    """The part of a game that names its states; see `hno.games.base.Game`."""

    state_names: ClassVar[Sequence[str]] = ()
    """Of a player's states; `x0`, `x1`, ... where they are missing. Player 2's `px` is the coordinate `px_2`."""
    state_units: ClassVar[Sequence[str]] = ()
    """Of a player's states."""
    relative_names: ClassVar[Sequence[str]] = ()
    """Coordinates that are the components of player 2's position minus player 1's, m; `positions` is affine then."""
    base: ClassVar[Mapping[str, float]] = MappingProxyType({})
    """Coordinates of the state that slices go through, from which axes move; others are in the middle of the start
    box."""
    plane: ClassVar[Plane | None] = None
    """What pictures show first; by default the first state of players 1 and 2, or the first two states of one."""

    def coordinates(self) -> dict[str, Coordinate]:
        """Every state of every player, and the relative ones, by name.

        Raises:
            ValueError: names or units do not fit the states, or relative ones `positions`.
        """
        game = cast("Game", self)
        states = list(enumerate(self.named_states()))
        found = [_state(game, player, one) for player in range(game.players) for one in states]
        return {one.name: one for one in [*found, *_relative(game, self.relative_names)]}

    def named_states(self) -> list[tuple[str, str]]:
        """Name and unit of each of a player's states.

        Raises:
            ValueError: there are not as many as states.
        """
        game = cast("Game", self)
        names = list(self.state_names) or [f"x{place}" for place in range(game.state_dim)]
        units = list(self.state_units) or [""] * game.state_dim
        if not len(names) == len(units) == game.state_dim:
            raise ValueError(
                f"{type(self).__name__} has {game.state_dim} states per player: state_names and state_units must have "
                f"as many entries; they are {names} and {units}."
            )
        return list(zip(names, units, strict=True))

    def base_state(self) -> Tensor:
        """The state that slices go through, (P, n), float64. Raises as `coordinate`."""
        game = cast("Game", self)
        x = ((game.initial_box.lo + game.initial_box.hi) / 2).detach().cpu().double()
        for name, value in self.base.items():
            x = self.coordinate(name).put(x, value)
        return x

    def default_plane(self) -> Plane:
        """`plane`, or the first state of players 1 and 2, or the first two states of one player.

        Raises:
            ValueError: there is one coordinate alone.
        """
        game = cast("Game", self)
        if self.plane is not None:
            return self.plane
        if game.players * game.state_dim < 2:
            raise ValueError(f"{type(self).__name__} has one state alone, which is no plane: there is no slice of it.")
        names = list(self.coordinates())
        return Plane(Axis(names[0]), Axis(names[game.state_dim if game.players > 1 else 1]))

    def coordinate(self, name: str) -> Coordinate:
        """A coordinate by its name.

        Raises:
            ValueError: there is none of this name; the message has those that there are.
        """
        known = self.coordinates()
        if name not in known:
            near = difflib.get_close_matches(str(name), known, 1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            kind = type(self).__name__
            raise ValueError(f"{kind} has no coordinate {name!r}.{hint} It has {', '.join(known)}.")
        return known[name]


def _state(game: Game, player: int, state: tuple[int, tuple[str, str]]) -> Coordinate:
    place, (name, unit) = state
    weights = torch.zeros(game.players, game.state_dim, dtype=torch.float64)
    weights[player, place] = 1
    lo, hi = (float(end[player, place]) for end in (game.state_box.lo, game.state_box.hi))
    return Coordinate(f"{name}_{player + 1}", unit, weights, 0.0, lo, hi)


def _relative(game: Game, names: Sequence[str]) -> list[Coordinate]:
    """Components of the way from player 1 to player 2, which must be affine functions of the state."""
    if not names:
        return []
    box = copy.deepcopy(game.state_box).cpu().double()

    def apart(x: Tensor) -> Tensor:
        one, other = game.positions(x.to(game.state_box.lo)).double().cpu()[:, :2].unbind(1)
        return other - one

    units = torch.eye(box.lo.numel(), dtype=torch.float64).view(-1, *box.lo.shape)
    origin = apart(torch.zeros_like(box.lo).unsqueeze(0))[0]
    weights = (apart(units) - origin).mT.reshape(-1, *box.lo.shape)
    some = box.sample(8, torch.Generator().manual_seed(0))
    affine = torch.einsum("dpn,bpn->bd", weights, some) + origin
    if len(names) != len(origin) or not torch.allclose(affine, apart(some), atol=1e-3):
        raise ValueError(
            f"relative_names of {type(game).__name__} are {list(names)}: they need one name for each of the "
            f"{len(origin)} components of positions, which must be affine functions of the state."
        )
    ends = weights * box.lo, weights * box.hi
    low, high = (extreme(*ends).sum((-1, -2)) + origin for extreme in (torch.minimum, torch.maximum))
    rows = zip(names, weights, origin, low, high, strict=True)
    return [Coordinate(name, "m", weight, *map(float, rest)) for name, weight, *rest in rows]
