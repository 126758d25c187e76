"""What a differential game is: boxes, dynamics, costs, a constraint, and the control that maximises the Hamiltonian."""

from __future__ import annotations

import abc
import copy
import hashlib
import math
import warnings
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import torch
from torch import Tensor, nn

from hno.games.box import Box
from hno.registry import Registry

games: Registry[Game] = Registry("game", "hno.games")


class ExtrapolationWarning(UserWarning):
    """Player types outside the range that a game is made for."""


class Game(nn.Module, abc.ABC):
    """A P-player general-sum differential game with state constraints, in reward form (players maximise V = -J).

    The dynamics are decoupled: `dynamics(x, u)[..., i, :]` depends on the state and control of player i alone. What
    couples the players is the constraint, which enters every running cost as `penalty(constraint)` (paper, eq. 5).

    A subclass sets the attributes below and overrides the abstract methods; the other methods are shared and final.
    Methods accept any leading batch shape and both float32 and float64.
    """

    constants: Mapping[str, float | Sequence[float]] = MappingProxyType({})
    """Constructor arguments that differ from the defaults."""
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
    """Admissible controls of each player, (m,)."""
    type_box: Box
    """Range of each player's type, (P,)."""
    penalty_height: float = 1e4
    """Cost rate deep inside the violation set, 1/s."""
    penalty_slope: float = 5.0
    """Steepness of the penalty, 1/m for distance constraints."""
    constraint_unit: str = "m"
    """Unit of the constraints, and so of the clearance; m says that they are distances."""

    @abc.abstractmethod
    def dynamics(self, x: Tensor, u: Tensor) -> Tensor:
        """Time derivative of the state, (B, P, n), (B, P, m) -> (B, P, n)."""

    @abc.abstractmethod
    def effort(self, u: Tensor) -> Tensor:
        """Control part of the running cost, (B, P, m) -> (B, P)."""

    @abc.abstractmethod
    def terminal_value(self, x: Tensor) -> Tensor:
        """Reward -g_i at the end, (B, P, n) -> (B, P)."""

    @abc.abstractmethod
    def constraint(self, x: Tensor, theta: Tensor) -> Tensor:
        """State constraint, at most 0 where safe, (B, P, n), (B, P) -> (B, P)."""

    @abc.abstractmethod
    def sensors(self, theta: Tensor) -> Tensor:
        """Branch input: the indicator of the violation set on a lattice (paper, sec. III), (B, P) -> (B, P, S)."""

    @abc.abstractmethod
    def best_response(self, x: Tensor, own_costate: Tensor) -> Tensor:
        """Argmax of each player's Hamiltonian over its control box, (B, P, n), (B, P, n) -> (B, P, m)."""

    @abc.abstractmethod
    def positions(self, x: Tensor) -> Tensor:
        """Where the players are in one common frame, m, (B, P, n) -> (B, P, 2 or 3); distances and pictures use it."""

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

    def penalty(self, constraint: Tensor) -> Tensor:
        """Soft constraint b sigmoid(gamma c) (paper, eq. 5), same shape as `constraint`."""
        return self.penalty_height * torch.sigmoid(self.penalty_slope * constraint)

    def running_cost(self, x: Tensor, u: Tensor, theta: Tensor) -> Tensor:
        """Effort plus penalty, 1/s, (B, P)."""
        return self.effort(u) + self.penalty(self.constraint(x, theta))

    def hamiltonian(self, x: Tensor, costate: Tensor, u: Tensor, theta: Tensor) -> Tensor:
        """H_i = sum_j <dV_i/dx_j, f_j> - running cost of i, shape (B, P)."""
        flow = torch.einsum("...ijn,...jn->...i", costate, self.dynamics(x, u))
        return flow - self.running_cost(x, u, theta)

    def optimal_control(self, x: Tensor, costate: Tensor) -> Tensor:
        """Every player's maximiser of its own Hamiltonian, (B, P, n), (B, P, P, n) -> (B, P, m)."""
        return self.best_response(x, own_costate(costate))

    def violates(self, x: Tensor, theta: Tensor) -> Tensor:
        """Whether any player's constraint is violated (or just met), shape (B,)."""
        return (self.constraint(x, theta) >= 0).any(-1)

    def validate_types(self, types: Sequence[Sequence[float]]) -> list[tuple[float, ...]]:
        """Player types as tuples of floats, with an `ExtrapolationWarning` for those outside the type box.

        Raises:
            ValueError: a type that is not one finite number per player.
        """
        checked = []
        for theta in types:
            entries = _numbers(theta)
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

    def fingerprint(self) -> str:
        """Hash of the game's boxes and of its functions at fixed points: it changes when the physics does.

        It is taken on the CPU in float64, so that it is the same wherever the game is.
        """
        game = copy.deepcopy(self).cpu().double()
        generator = torch.Generator().manual_seed(0)
        boxes = [game.state_box, game.initial_box, game.control_box, game.type_box]
        x, theta = game.state_box.sample(16, generator), game.type_box.sample(16, generator)
        u = game.control_box.sample(16, generator).unsqueeze(-2).expand(-1, game.players, -1)
        values = [corner for box in boxes for corner in (box.lo, box.hi)]
        values += [game.dynamics(x, u), game.effort(u), game.terminal_value(x), game.constraint(x, theta)]
        values += [game.sensors(theta), game.positions(x), game.penalty(torch.linspace(-2, 2, 9, dtype=x.dtype))]
        digits = [f"{v:.4e}" for tensor in values for v in tensor.flatten().tolist()]
        text = repr((type(self).__name__, self.horizon, self.label_step, self.roles, digits))
        return hashlib.sha256(text.encode()).hexdigest()[:16]


class ControlAffineGame(Game):
    """A game whose dynamics are drift(x) + G w(u) with effort sum_k r_k w_k^2, w an increasing map of each control.

    The Hamiltonian is then a concave parabola in every w_k, so its maximiser on a box is the clamped vertex, exactly:
    w = clamp(G' lambda_ii / 2r).
    """

    input_matrix: Tensor
    """G, shape (n, m), a buffer."""
    effort_weight: Tensor
    """r, shape (m,), a buffer."""

    @abc.abstractmethod
    def drift(self, x: Tensor) -> Tensor:
        """Dynamics at w = 0, (B, P, n) -> (B, P, n)."""

    def affine_input(self, u: Tensor) -> Tensor:
        """w(u), the input in which the dynamics are affine, (B, P, m) -> (B, P, m)."""
        return u

    def control_of(self, w: Tensor) -> Tensor:
        """Inverse of `affine_input`."""
        return w

    def dynamics(self, x: Tensor, u: Tensor) -> Tensor:
        """Time derivative of the state, (B, P, n)."""
        return self.drift(x) + self.affine_input(u) @ self.input_matrix.mT

    def effort(self, u: Tensor) -> Tensor:
        """Weighted squares of the affine input, 1/s, (B, P)."""
        return self.affine_input(u).square() @ self.effort_weight

    def best_response(self, x: Tensor, own_costate: Tensor) -> Tensor:
        """The clamped vertex of each player's Hamiltonian, (B, P, m)."""
        vertex = own_costate @ self.input_matrix / (2 * self.effort_weight)
        return self.control_of(vertex.clamp(*map(self.affine_input, (self.control_box.lo, self.control_box.hi))))


def _numbers(entries: object) -> tuple[float, ...]:
    """Entries of a sequence as floats; none if it is no sequence of numbers."""
    try:
        return tuple(float(entry) for entry in entries)  # type: ignore[attr-defined]  # that is what is tried
    except (TypeError, ValueError):
        return ()


def own_costate(costate: Tensor) -> Tensor:
    """The diagonal dV_i / dx_i of a costate, (B, P, P, n) -> (B, P, n)."""
    return costate.diagonal(dim1=-3, dim2=-2).mT
