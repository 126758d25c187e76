"""Value operators: functions of time to go, joint state and player types, apart from how they are trained."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor, nn
from torch.func import jacrev

from hno.games import Game
from hno.games.potential import Problem, Team
from hno.losses import Scales, View
from hno.registry import Registry
from hno.types import Field, Points, PotentialField, Sample, Types

functions: Registry[Any] = Registry("function", "hno.operators")
"""What is learned: subclasses of `ValueOperator`."""

FieldFunction = Callable[[Points, Types | None], Field | PotentialField]
"""As `ValueOperator.field`."""


class _Refused(torch.autograd.Function):
    """0, whose derivatives are refused."""

    generate_vmap_rule = True

    @staticmethod
    def forward(*points: Tensor) -> Tensor:
        return points[0].new_zeros(())

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor, ...]:
        raise RuntimeError(_REFUSAL)

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor) -> Tensor:
        raise RuntimeError(_REFUSAL)


_REFUSAL = (
    "A field is not differentiable in its points (tau, x, theta). Its derivatives are its entries `costate` and "
    "`dvalue_dtau`; what autograd and torch.func take is `operator.value`, or `policy.answer` of one state."
)

F = TypeVar("F", Field, PotentialField)


def at_fixed_points(field: F, points: Points) -> F:
    """The field, of which any derivative in the points, by reverse or forward mode, is a RuntimeError.

    Networks see the points detached: without this a derivative would be finite, and that of the other parts alone.
    """
    zero: Tensor = _Refused.apply(*points)  # type: ignore[no-untyped-call]  # torch does not annotate it
    return type(field)(*(part + zero for part in field)) if zero.requires_grad else field


class ValueOperator(nn.Module, abc.ABC):
    """V(tau, x, theta) of every player of a game, in physical units.

    A registered class is built as `cls(game, network, **options)`, see `hno.operators.build`.

    Args:
        game: the game.
    """

    potential: ClassVar[bool] = False
    """Whether it learns a potential W rather than the players' values V_i."""
    meets_terminal: bool = False
    """Whether V(0, x) = -g(x) holds by construction."""
    value_scale: Tensor
    """Typical size of values, scalar: what the operator's own outputs are multiplied with."""
    costate_scale: Tensor
    """Typical sizes of costates, (P, P, n), or (1, P, n) of a potential."""
    jacobian: Callable[..., Any] = staticmethod(jacrev)
    """How `value_and_costate` differentiates; `jacfwd` gives the same by what does not depend on the types, first."""

    def __init__(self, game: Game) -> None:
        super().__init__()
        self.game = game
        self.problem: Problem = Team(game) if self.potential else game
        """Whose Hamilton-Jacobi equation it is: the game, or its `Team` where a potential is learned."""
        functions = 1 if self.potential else game.players
        self.register_buffer("value_scale", torch.tensor(1.0))
        self.register_buffer("costate_scale", torch.ones(functions, game.players, game.state_dim))

    @abc.abstractmethod
    def field(self, points: Points, types: Types | None = None) -> Field | PotentialField:
        """Value, time derivative and every costate, of all players at once, or of the potential.

        With gradients enabled the result is differentiable in the parameters. In the points it is not, which
        `at_fixed_points` makes an error: see `value`.

        Args:
            points: where, physical units.
            types: the points' theta as a table, which is searched for otherwise.
        """

    @property
    def members(self) -> Sequence[FieldFunction]:
        """What is trained side by side: the loss is its mean over the members."""
        return [self.field]

    @abc.abstractmethod
    def value(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """V_i, (B,), (B, P, n), (B, P) -> (B, P): a pure function, differentiable in everything.

        `torch.func` transforms, `torch.compile` and autograd in the states take it; `field` is faster.
        """

    @abc.abstractmethod
    def value_and_costate(self, tau: Tensor, x: Tensor, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Values (P,) and costates (Q, P, n) of one state, (), (P, n), (P,): a pure function as `value`."""

    def forward(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """The value."""
        return self.value(tau, x, theta)

    def view(
        self,
        sample: Sample,
        field: Field | PotentialField,
        at: Callable[[Points], Field | PotentialField] | None = None,
        step: int = 0,
    ) -> View:
        """What a loss term sees of the operator, whose field at the sample is given; `at` is `field` by default."""
        return View(self.game, self.problem, sample, field, at or self.field, self.scales, step)

    def compile_kernels(self) -> None:
        """Train through `torch.compile`, where the operator knows how; it pays in long runs."""

    @property
    def scales(self) -> Scales:
        """Typical sizes of values and costates."""
        return Scales(self.value_scale, self.costate_scale)

    def set_branches(self, branch: Tensor) -> None:
        """Play those branches of a potential only that labels have, int64, any shape; kept with the weights."""

    def set_scales(self, scales: Scales) -> None:
        """Fix the sizes in which outputs and residuals are measured; they are saved with the weights."""
        self.value_scale.copy_(scales.value)
        self.costate_scale.copy_(scales.costate)
