"""Controllers: what `hno.control.rollout` plays."""

from __future__ import annotations

import abc
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor, nn

from hno.control.questions import X, in_type_of, outside, question
from hno.control.slices import POINTS, AxisLike, Slice, chosen_plane, take
from hno.games import Game
from hno.games.base import ExtrapolationWarning
from hno.operators.base import ValueOperator
from hno.types import Field, Numbers, Points, PotentialField


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

    Questions are times to go (B,), states (B, P, n) and types (B, P). States may have any leading shape: of one state
    (P, n) the answer has no B, and none are none. One number is a time to go for all states, one (P,) are the types
    of all. Numbers, lists and arrays will do; the answer is an array if the states are one, and has their
    floating-point type. It is not differentiable in the question: see `answer`.

    Args:
        operator: a trained operator.
        checked: refuse wrong shapes, entries that are not finite and times to go outside the horizon, and warn once of
            states outside the PDE box. Without it a question consists of tensors of shapes as above, and an operator
            that has diverged answers NaN, which a rollout counts as a collision.
    """

    def __init__(self, operator: ValueOperator, checked: bool = True) -> None:
        super().__init__()
        self.operator, self.checked = operator, checked
        self._warned = False

    @property
    def game(self) -> Game:
        """The game that the policy plays."""
        return self.operator.game

    def forward(self, tau: Numbers, x: X, theta: Numbers) -> X:
        """As `act`."""
        return self.act(tau, x, theta)

    def act(self, tau: Numbers, x: X, theta: Numbers) -> X:
        """Controls in physical units, (B, P, m).

        Raises:
            ValueError: shapes do not fit the game or each other, an entry is not finite, or a time to go is not within
                the horizon.
        """
        return self._asked(tau, x, theta, self._controls)

    def value(self, tau: Numbers, x: X, theta: Numbers) -> X:
        """V_i of every player, (B, P). Raises as `act`."""
        return self._asked(tau, x, theta, lambda at: _values(self.operator.field(at)))

    def potential(self, tau: Numbers, x: X, theta: Numbers) -> X:
        """W of an operator of a potential, (B,).

        Raises:
            ValueError: as `act`, or the operator has none.
        """
        return self._asked(tau, x, theta, lambda at: _potential(self.operator.field(at)).value.squeeze(-1))

    def branch(self, tau: Numbers, x: X, theta: Numbers) -> X:
        """Which branch of a potential is played, int64, (B,); see `hno.data.branches`.

        Raises:
            ValueError: as `act`, or the operator has none.
        """
        return self._asked(tau, x, theta, lambda at: _potential(self.operator.field(at)).branches.argmax(-1))

    def costate(self, tau: Numbers, x: X, theta: Numbers) -> X:
        """dV_i / dx_j, (B, P, P, n), or dW / dx_j, (B, 1, P, n). Raises as `act`."""
        return self._asked(tau, x, theta, lambda at: self.operator.field(at).costate)

    def slice(
        self,
        across: AxisLike | None = None,
        up: AxisLike | None = None,
        *,
        theta: Numbers | None = None,
        tau: float | None = None,
        at: Mapping[str, float] | None = None,
        points: int = POINTS,
    ) -> Slice:
        """Values, costates, controls and the constraint on a grid over two coordinates of the joint state.

        Coordinates are those of `game.coordinates()`: state and player, such as "px_1" and "v_2", and relative ones
        where the game has some, such as "gap" and "offset".

        Args:
            across: what runs to the right, a name or (name, from, to); by default to the edges of the PDE box.
            up: what runs upwards; neither of both for the game's own slice.
            theta: player types, (P,); the middle of the type box by default.
            tau: time to go, s; half the horizon by default.
            at: values of other coordinates by name; those that are not named are as in `game.base_state()`.
            points: along each side.

        Raises:
            ValueError: a coordinate that does not exist or that another one moves, an empty range, too few points; or
                as `act`.
        """
        return take(self, chosen_plane(self.game, across, up, at), theta, tau, points)

    def answer(self, tau: Tensor, x: Tensor, theta: Tensor) -> Answer:
        """Value, costates and controls of one state, (), (P, n), (P,): a pure function without checks.

        In the floating-point type of `x`. `torch.vmap`, `torch.func.jacrev` and `torch.compile` take it.
        """
        points = self._cast(tau, x, theta)
        value, costate = self.operator.value_and_costate(*points)
        control = self.operator.problem.optimal_control(points.x, costate)
        return Answer(value.to(x.dtype), costate.to(x.dtype), control.to(x.dtype))

    def export(self, to: str, folder: str | Path) -> Path:
        """Write the controller for use without this package, see `hno.export.export`.

        Args:
            to: numpy, c, onnx or torch.
            folder: where; new, empty, or an earlier export.
        """
        from hno.export import export

        return export(self.operator, to, folder, self.origin())

    def origin(self) -> dict[str, Any]:
        """Where the operator comes from, plain containers."""
        return {}

    def _controls(self, at: Points) -> Tensor:
        return self.operator.problem.optimal_control(at.x, self.operator.field(at).costate)

    def _asked(self, tau: Any, x: Any, theta: Any, answer: Callable[[Points], Tensor]) -> Any:
        """What is answered at the points, as the question came."""
        if not self.checked:
            return in_type_of(x, answer(self._cast(tau, x, theta)))
        asked = question(self.game, tau, x, theta, self.operator.value_scale)
        if not self._warned and bool(outside(self.game, asked.points.x).any()):
            self._warned = True
            message = "x lies outside the PDE box of the game, where nothing was learned: do not trust answers there."
            warnings.warn(f"{message} This policy says so once.", ExtrapolationWarning, stacklevel=3)
        return asked.answered(answer(asked.points))

    def _cast(self, tau: Tensor, x: Tensor, theta: Tensor) -> Points:
        """The question in the operator's floating-point type."""
        dtype = self.operator.value_scale.dtype
        return Points(tau.to(dtype), x.to(dtype), theta.to(dtype))


def _values(field: Field | PotentialField) -> Tensor:
    return field.players if isinstance(field, PotentialField) else field.value


def _potential(field: Field | PotentialField) -> PotentialField:
    if not isinstance(field, PotentialField):
        raise ValueError("This policy knows the players' values, no potential: train it with function=potential.")
    return field
