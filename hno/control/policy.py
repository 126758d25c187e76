"""Controllers: what `hno.control.rollout` plays."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor, nn

from hno.games import Game
from hno.operators.base import ValueOperator
from hno.types import Points, PotentialField


class Policy(abc.ABC):
    """Feedback controls of all players of a batch of episodes.

    A policy without memory defines `act` alone.
    """

    def reset(self, x0: Tensor, theta: Tensor) -> None:  # noqa: B027  # nothing to forget by default
        """An episode begins at states (B, P, n) with types (B, P); what was remembered is forgotten."""

    @abc.abstractmethod
    def act(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """Controls in physical units, (B,), (B, P, n), (B, P) -> (B, P, m)."""

    def observe(self, x: Tensor, u: Tensor, dt: float) -> None:  # noqa: B027  # nothing to remember by default
        """What happened since the last call: states now (B, P, n), controls that led here (B, P, m), held for dt, s."""

    def __call__(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """As `act`."""
        return self.act(tau, x, theta)


class FunctionPolicy(Policy):
    """A policy without memory from a function.

    Args:
        function: as `Policy.act`.
    """

    def __init__(self, function: Callable[[Tensor, Tensor, Tensor], Tensor]) -> None:
        self.function = function

    def act(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """What the function answers."""
        return self.function(tau, x, theta)


def as_policy(policy: Policy | Callable[[Tensor, Tensor, Tensor], Tensor]) -> Policy:
    """A policy as it is, a bare function (tau, x, theta) -> controls wrapped into one."""
    return policy if isinstance(policy, Policy) else FunctionPolicy(policy)


class Answer(NamedTuple):
    """What a controller says of one state."""

    value: Tensor
    """V_i, (P,)."""
    costate: Tensor
    """dV_i / dx_j, (P, P, n), or dW / dx_j, (1, P, n)."""
    control: Tensor
    """(P, m)."""


class Feedback(nn.Module, Policy):
    """The controls that maximise every player's Hamiltonian at an operator's costates (paper, eq. 3).

    Args:
        operator: a trained operator.
        checked: refuse wrong shapes and entries that are not finite; without it an operator that has diverged answers
            NaN, which a rollout counts as a collision.
    """

    def __init__(self, operator: ValueOperator, checked: bool = True) -> None:
        super().__init__()
        self.operator, self.checked = operator, checked

    @property
    def game(self) -> Game:
        """The game that the policy plays."""
        return self.operator.game

    def forward(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """As `act`."""
        return self.act(tau, x, theta)

    def act(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """Controls in physical units, (B,), (B, P, n), (B, P) -> (B, P, m), in the floating-point type of `x`.

        Raises:
            ValueError: shapes do not fit the game or each other, or an entry is not finite.
        """
        points = self._points(tau, x, theta)
        return self.operator.problem.optimal_control(points.x, self.operator.field(points).costate).to(x.dtype)

    def value(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """V_i of every player, (B,), (B, P, n), (B, P) -> (B, P). Raises as `act`."""
        field = self.operator.field(self._points(tau, x, theta))
        return (field.players if isinstance(field, PotentialField) else field.value).to(x.dtype)

    def potential(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """W of an operator of a potential, (B,), (B, P, n), (B, P) -> (B,).

        Raises:
            ValueError: as `act`, or the operator has none.
        """
        return self._potential_field(tau, x, theta).value.squeeze(-1).to(x.dtype)

    def branch(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """Which branch of a potential is played, int64, (B,), (B, P, n), (B, P) -> (B,); see `hno.data.branches`.

        Raises:
            ValueError: as `act`, or the operator has none.
        """
        return self._potential_field(tau, x, theta).branches.argmax(-1)

    def _potential_field(self, tau: Tensor, x: Tensor, theta: Tensor) -> PotentialField:
        field = self.operator.field(self._points(tau, x, theta))
        if not isinstance(field, PotentialField):
            raise ValueError("This policy knows the players' values, no potential: train it with function=potential.")
        return field

    def costate(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """dV_i / dx_j, (B,), (B, P, n), (B, P) -> (B, P, P, n), or dW / dx_j, (B, 1, P, n). Raises as `act`."""
        return self.operator.field(self._points(tau, x, theta)).costate.to(x.dtype)

    def answer(self, tau: Tensor, x: Tensor, theta: Tensor) -> Answer:
        """Value, costates and controls of one state, (), (P, n), (P,): a pure function without checks.

        In the floating-point type of `x`. `torch.vmap`, `torch.func.jacrev` and `torch.compile` take it.
        """
        points = self._cast(tau, x, theta)
        value, costate = self.operator.value_and_costate(*points)
        control = self.operator.problem.optimal_control(points.x, costate)
        return Answer(value.to(x.dtype), costate.to(x.dtype), control.to(x.dtype))

    def _points(self, tau: Tensor, x: Tensor, theta: Tensor) -> Points:
        """The question, checked."""
        if self.checked:
            check_question(self.game, tau, x, theta)
        return self._cast(tau, x, theta)

    def _cast(self, tau: Tensor, x: Tensor, theta: Tensor) -> Points:
        """The question in the operator's floating-point type."""
        dtype = self.operator.value_scale.dtype
        return Points(tau.to(dtype), x.to(dtype), theta.to(dtype))


def check_question(game: Game, tau: Tensor, x: Tensor, theta: Tensor) -> None:
    """Refuse what a controller has no answer to.

    Raises:
        ValueError: shapes do not fit the game or each other, or an entry is not finite.
    """
    batch, joint = x.shape[:-2], (game.players, game.state_dim)
    if x.shape[-2:] != joint or tau.shape != batch or theta.shape != (*batch, joint[0]):
        raise ValueError(
            f"Expected tau (B,), x (B, {joint[0]}, {joint[1]}) and theta (B, {joint[0]}); "
            f"got {tuple(tau.shape)}, {tuple(x.shape)} and {tuple(theta.shape)}."
        )
    game.check_theta(theta)
    if not bool(tau.isfinite().all() & x.isfinite().all()):
        raise ValueError("tau and x must be finite; a controller has no answer to NaN or infinite entries.")
