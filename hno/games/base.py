"""What a differential game is: boxes, dynamics, costs, a constraint, and the control that maximises the Hamiltonian."""

from __future__ import annotations

import abc
import math
import warnings
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from hno.games.box import Box
from hno.games.final import FinalMethods
from hno.games.fingerprint import fingerprint
from hno.games.plane import Coordinates
from hno.games.scene import Scene
from hno.registry import Registry

games: Registry[Game] = Registry("game", "hno.games", base="hno.games.base:Game")
REQUIRED = ("horizon", "state_box", "initial_box", "control_box", "type_box")
"""What every game sets, as attributes of its class or in its constructor."""


class ExtrapolationWarning(UserWarning):
    """Player types or states outside the range that a game is made for."""


class Game(FinalMethods, Coordinates, nn.Module, abc.ABC):
    """A P-player general-sum differential game with state constraints, in reward form (players maximise V = -J).

    The dynamics are decoupled: `dynamics(x, u)[..., i, :]` depends on the state and control of player i alone. What
    couples the players is the running cost of states (paper, eq. 5), mostly the penalty of the constraints.

    A subclass sets the attributes below and overrides abstract methods and defaults; those in `INSTEAD` are final.
    Methods accept any leading batch shape B, the same for all arguments, and both float32 and float64.
    """

    INSTEAD: ClassVar[Mapping[str, str]] = {
        "running_cost": "effort, state_cost or penalty",
        "uncontrolled_cost": "state_cost or penalty",
        "hamiltonian": "dynamics, effort, state_cost or penalty",
        "optimal_control": "best_response",
        "violates": "constraint",
        "validate_types": "type_box",
        "check_theta": "type_box",
        "check_constants": "positive",
        "overrides": "the method in question",
        "fingerprint": "the methods that it hashes",
        "players": "roles",
        "state_dim": "state_box",
        "control_dim": "control_box",
    }

    constants: Mapping[str, float | Sequence[float]] = MappingProxyType({})
    """Constructor arguments that differ from the defaults."""
    positive: ClassVar[tuple[str, ...]] = ("horizon", "label_step", "penalty_height", "penalty_slope")
    """Attributes that must be positive numbers; those of a subclass are added to those of its bases."""
    horizon: float
    """Length of the game, s."""
    label_step: float = 0.1
    """Spacing of label nodes, s."""
    roles: tuple[int, ...] = (0, 0)
    """One entry per player; players with equal entries are interchangeable."""
    state_box: Box
    """PDE domain, which also scales the operator's inputs, (P, n)."""
    initial_box: Box
    """Where episodes start, (P, n)."""
    control_box: Box
    """Admissible controls, (m,), or (P, m) where players differ."""
    type_box: Box
    """Range of each player's type, (P,)."""
    periodic: tuple[int, ...] = ()
    """Places in a player's state that wrap, such as a heading; the edge of `state_box` is one period, 2 pi for an angle
    in rad."""
    penalty_height: float = 1e4
    """Cost rate deep inside the violation set, 1/s."""
    penalty_slope: float = 5.0
    """Steepness of the penalty, per unit of the constraint."""
    constraint_unit: str = "m"
    """Unit of the constraints, and so of the clearance."""
    distance_constraints: bool = True
    """Whether they are radii minus distances of `positions`; pictures draw the radius then."""
    potential: bool = False
    """Whether it is an exact potential game with the cost of states `potential_cost`, see `hno.games.potential`."""

    def __getattr__(self, name: str) -> Any:
        """Name what a game has not set, also where one of its properties needs it."""
        needed = {"state_dim": "state_box", "control_dim": "control_box"}.get(name, name)
        if needed in REQUIRED and needed not in self.__dict__.get("_modules", {}):
            raise AttributeError(f"{type(self).__name__} has no {needed}; every game sets {', '.join(REQUIRED)}")
        return super().__getattr__(name)

    @abc.abstractmethod
    def dynamics(self, x: Tensor, u: Tensor) -> Tensor:
        """Time derivative of the state, (B, P, n), (B, P, m) -> (B, P, n)."""

    @abc.abstractmethod
    def effort(self, u: Tensor) -> Tensor:
        """Control part of the running cost, 1/s, (B, P, m) -> (B, P)."""

    @abc.abstractmethod
    def terminal_value(self, x: Tensor) -> Tensor:
        """Reward -g_i at the end, (B, P, n) -> (B, P)."""

    @abc.abstractmethod
    def constraint(self, x: Tensor, theta: Tensor) -> Tensor:
        """State constraints of every player, below 0 where safe, (B, P, n), (B, P) -> (B, P, C) with C >= 1.

        Players who keep distance have one constraint per other player: the largest of several has kinks.
        """

    @abc.abstractmethod
    def best_response(self, x: Tensor, own_costate: Tensor) -> Tensor:
        """Argmax of each player's Hamiltonian over its control box, (B, P, n), (B, P, n) -> (B, P, m)."""

    @abc.abstractmethod
    def positions(self, x: Tensor) -> Tensor:
        """Where the players are in one common frame, m, (B, P, n) -> (B, P, 2 or 3); distances and pictures use it."""

    def scene(self) -> Scene:
        """What pictures draw around the players, and names; nothing is decided by it. Points in empty space."""
        return Scene()

    def state_cost(self, x: Tensor, theta: Tensor) -> Tensor:
        """Further running cost of states, such as tracking, 1/s, (B, P, n), (B, P) -> (B, P); 0 by default."""
        return torch.zeros_like(x[..., 0])

    def soft_constraint(self, constraint: Tensor) -> Tensor:
        """Cost rate b sigmoid(gamma c) of a constraint (paper, eq. 5), 1/s, the same shape."""
        return self.penalty_height * torch.sigmoid(self.penalty_slope * constraint)

    def penalty(self, x: Tensor, theta: Tensor) -> Tensor:
        """Sum of soft constraints by default, 1/s, (B, P, n), (B, P) -> (B, P)."""
        return self.soft_constraint(self.constraint(x, theta)).sum(-1)

    def potential_cost(self, x: Tensor, theta: Tensor) -> Tensor:
        """Cost of states of the potential, 1/s, (B, P, n), (B, P) -> (B,): what players share counts once.

        By default the state costs, and half of the penalties, each of which two players share. Where players bear a
        penalty alone, or more than two share one, it is to be overridden.
        """
        share = 1.0 if self.players == 1 else 0.5
        return self.state_cost(x, theta).sum(-1) + share * self.penalty(x, theta).sum(-1)

    def sensors(self, theta: Tensor) -> Tensor:
        """Branch input of an operator, (B, P) -> (B, P, S): by default the own type and those of the others, scaled.

        It must not change when other players of equal role swap, so the others are sorted. The paper's input is the
        indicator of the violation set on a lattice (sec. III).
        """
        scaled, players = self.type_box.scale(theta), range(self.players)
        others = torch.tensor([[j for j in players if j != i] for i in players], dtype=torch.long, device=theta.device)
        return torch.cat([scaled.unsqueeze(-1), scaled[..., others].sort(descending=True).values], -1)

    def default_types(self) -> list[tuple[float, ...]]:
        """Types that labels are solved at by default, 3 P + 1 of them.

        All players at the low end of their ranges, one at the high end, all at the high end, and a staircase of half
        ranges from low to high.
        """
        players = range(self.players)
        steps = [[0] * self.players, *([2 * (j == i) for j in players] for i in reversed(players)), [2] * self.players]
        for level in (0, 1):
            steps += [[level + (j >= i) for j in players] for i in reversed(players)]
        lo, hi = self.type_box.lo.tolist(), self.type_box.hi.tolist()
        types = [tuple(a + (b - a) * k / 2 for a, b, k in zip(lo, hi, step, strict=True)) for step in steps]
        return list(dict.fromkeys(types))

    @property
    def players(self) -> int:
        """Number of players P."""
        return len(self.roles)

    @property
    def state_dim(self) -> int:
        """Number of states per player n."""
        return self.state_box.lo.shape[-1]

    @property
    def control_dim(self) -> int:
        """Number of controls per player m."""
        return self.control_box.lo.shape[-1]

    def uncontrolled_cost(self, x: Tensor, theta: Tensor, constraint: Tensor | None = None) -> Tensor:
        """The running cost without the effort, 1/s, (B, P); who knows the constraint at `x` gives it."""
        if constraint is None or self.overrides("penalty"):
            return self.state_cost(x, theta) + self.penalty(x, theta)
        return self.state_cost(x, theta) + self.soft_constraint(constraint).sum(-1)

    def running_cost(self, x: Tensor, u: Tensor, theta: Tensor) -> Tensor:
        """Effort, state cost and penalty, 1/s, (B, P)."""
        return self.effort(u) + self.uncontrolled_cost(x, theta)

    def hamiltonian(self, x: Tensor, costate: Tensor, u: Tensor, theta: Tensor) -> Tensor:
        """H_i = sum_j <dV_i/dx_j, f_j> - running cost of i, shape (B, P)."""
        flow = torch.einsum("...ijn,...jn->...i", costate, self.dynamics(x, u))
        return flow - self.running_cost(x, u, theta)

    def optimal_control(self, x: Tensor, costate: Tensor) -> Tensor:
        """Every player's maximiser of its own Hamiltonian, (B, P, n), (B, P, P, n) -> (B, P, m)."""
        return self.best_response(x, own_costate(costate))

    def violates(self, x: Tensor, theta: Tensor) -> Tensor:
        """Whether any constraint is violated (or just met), (B,)."""
        return (self.constraint(x, theta) >= 0).flatten(-2).any(-1)

    def validate_types(self, types: Sequence[Sequence[float]]) -> list[tuple[float, ...]]:
        """Player types as tuples of floats, with an `ExtrapolationWarning` for those outside the type box.

        Raises:
            ValueError: a type that is not one finite number per player.
        """
        checked = []
        for theta in types:
            try:
                entries = tuple(map(float, theta))
            except (TypeError, ValueError):  # no sequence of numbers
                entries = ()
            if len(entries) != self.players or not all(map(math.isfinite, entries)):
                raise ValueError(f"theta must be {self.players} finite numbers, one per player; got {theta!r}.")
            self.check_theta(torch.tensor(entries, device=self.type_box.lo.device))
            checked.append(entries)
        return checked

    def check_theta(self, theta: Tensor) -> None:
        """Refuse types that are not finite, and warn of those outside the type box.

        Raises:
            ValueError: an entry of `theta` (B, P) is NaN or infinite.
        """
        if not bool(theta.isfinite().all()):
            raise ValueError(f"theta must be finite; got {theta.tolist()}.")
        if not bool(self.type_box.contains(theta).all()):
            lo, hi = self.type_box.lo.tolist(), self.type_box.hi.tolist()
            given = f" = {tuple(theta.tolist())}" if theta.dim() == 1 else ""
            message = f"theta{given} lies outside the types {lo} to {hi} of the game: results extrapolate."
            warnings.warn(message, ExtrapolationWarning, stacklevel=3)

    def check_constants(self) -> None:
        """Refuse attributes that must be positive and are not.

        Raises:
            ValueError: one of `positive` is not; the message names it.
        """
        for name in (name for base in type(self).__mro__ for name in vars(base).get("positive", ())):
            if not getattr(self, name) > 0:
                raise ValueError(f"{type(self).__name__} needs a positive {name}; got {getattr(self, name)}.")

    def overrides(self, name: str) -> bool:
        """Whether the game has a method of its own in the place of a default."""
        return getattr(type(self), name) is not getattr(Game, name)

    def fingerprint(self) -> str:
        """Hash of the game's boxes and of its functions at fixed points: it changes when the physics does."""
        return fingerprint(self)


def own_costate(costate: Tensor) -> Tensor:
    """The diagonal dV_i / dx_i of a costate, (B, P, P, n) -> (B, P, n)."""
    return costate.diagonal(dim1=-3, dim2=-2).mT
