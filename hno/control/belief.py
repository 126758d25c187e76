"""Players who do not know each other's types: they keep beliefs, and learn from how the others move."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, final

import torch
from torch import Tensor

from hno.control.policy import Feedback, Policy, as_policy
from hno.games import Game
from hno.runtime.belief import Learning, distribution
from hno.types import Numbers, tensor_of

ACTS = "mean", "mode", "expectation"
"""What players act on."""


@final
class FixedBelief(Policy):
    """Each player asks the policy about the types that it believes in, and plays its own part of the answer.

    Args:
        policy: asked once for every player.
        estimates: what each player takes all types to be, players running fastest, (B P, P).
    """

    def __init__(self, policy: Policy, estimates: Tensor) -> None:
        self.policy, self.estimates, self.players = policy, estimates, estimates.shape[-1]

    def _each(self, part: Tensor) -> Tensor:
        return part.repeat_interleave(self.players, 0)

    def reset(self, x0: Tensor, theta: Tensor) -> None:
        """An episode begins."""
        self.policy.reset(self._each(x0), self.estimates)

    def act(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """Controls, (B, P, m)."""
        answers = self.policy.act(self._each(tau), self._each(x), self.estimates).unflatten(0, theta.shape)
        return answers.diagonal(dim1=1, dim2=2).mT

    def observe(self, x: Tensor, u: Tensor, dt: float) -> None:
        """What happened."""
        self.policy.observe(self._each(x), self._each(u), dt)


@final
class Believing(Policy):
    """Plays a policy for known types by players of whom each knows its own type alone.

    Player i has a belief over the types of all others together: a probability for each combination of candidates.
    After every step Bayes' rule weighs each combination by how likely the controls that were seen are: the policy tells
    what the others would have done, and controls are normal around that (`Learning`). Where all candidates predict the
    same control, as on a bound of its box, nothing is learned.

    The prediction takes it that the others know all types, that of player i too. Where they learn as well, that is
    wrong at first. With `common` it takes it that they hold what is, of all that i knows, their estimate of its type:
    everybody has seen the same motion, so that this is exact for two players with the same prior and candidates.

    It acts on one of:
    - mean: the mean types of its belief (certainty equivalence);
    - mode: its most likely combination;
    - expectation: the control that maximises the expected Hamiltonian. Dynamics and efforts do not depend on types, so
      that it is the best response to the mean costate. It acts as if types were known from the next moment on (QMDP,
      Littman et al., 1995).

    All combinations of all players are one batched question to the policy: C^(P - 1) of them for each player.

    Args:
        policy: controls for known types, such as `hno.load_policy(...)`; for the expectation one with costates.
        types: candidates: a number of equal steps through the game's type box, or the types of every player, (C,) or
            (P, C).
        acts: one of the three above.
        learning: how beliefs follow what is seen.
        prior: weights of the combinations of the others' candidates, of a shape that is repeated to (B, P, C^(P - 1));
            equal ones by default. The order is that of `candidates`.
        common: see above.
        game: the game, where the policy does not say it.

    Raises:
        ValueError: numbers, words or shapes that make no sense; no game; no costates where they are needed.
    """

    belief: Tensor
    """What player i believes: a probability for each row of `candidates[i]`, float64, (B, P, K)."""

    def __init__(
        self,
        policy: Policy | Callable[[Tensor, Tensor, Tensor], Tensor],
        types: int | Numbers = 9,
        acts: str = "mean",
        learning: Learning = Learning(),
        prior: Numbers | None = None,
        common: bool = False,
        game: Game | None = None,
    ) -> None:
        self.policy: Any = as_policy(policy)
        if acts not in ACTS:
            raise ValueError(f"acts must be one of {', '.join(ACTS)}; got {acts!r}.")
        if acts == "expectation" and not isinstance(policy, Feedback):
            raise ValueError("The expected Hamiltonian needs costates, which a bare policy has not: take a Feedback.")
        found = game or getattr(policy, "game", None)
        if found is None:
            raise ValueError("This policy does not say which game it plays: give `game`.")
        self.game: Game = found
        self.acts, self.common, self.prior, self.learning = acts, common, prior, learning
        self.grid = _grid(self.game, types)
        """Candidates of every player, (P, C)."""
        self.candidates = _combinations(self.grid)
        """What the types of all may be, as player i sees it, (P, K, P); its own place is empty (0)."""
        self.learning.check()

    def reset(self, x0: Tensor, theta: Tensor) -> None:
        """All believe the prior again."""
        prior = None if self.prior is None else tensor_of("prior", self.prior).cpu().numpy()
        found = distribution(prior, (*theta.shape, self.candidates.shape[1]))
        self.belief = torch.from_numpy(found).to(x0.device)
        types = self._asked_types(theta)
        _ask(self.policy.reset, types, x0)

    def act(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """What each player does, given its own type and its belief, (B, P, m)."""
        types = self._asked_types(theta)
        answer = self._expected if self.acts == "expectation" else self._estimated
        self._predicted, controls = answer(tau, x, types)
        self._rows = math.prod(types.shape[1:3])
        return controls.diagonal(dim1=1, dim2=2).mT

    def observe(self, x: Tensor, u: Tensor, dt: float) -> None:
        """Bayes' rule for what the others did, (B, P, m)."""
        miss = (u[:, None, None] - self._predicted) / self.game.control_box.width.to(u)
        others = torch.where(self._own.unsqueeze(-1), 0, miss).flatten(-2).double().cpu().numpy()
        self.belief = torch.from_numpy(self.learning.updated(self.belief.cpu().numpy(), others, dt)).to(u.device)
        self.policy.observe(*(part.repeat_interleave(self._rows, 0) for part in (x, u)), dt)

    def estimates(self, theta: Tensor) -> Tensor:
        """What player i takes the type of j to be, its own as it is, (B, P, P): the most likely types, or the mean."""
        types, own = self._types(theta), self._own.squeeze(1)
        if self.acts == "mode":
            return types.take_along_dim(self.belief.argmax(-1)[..., None, None], 2).squeeze(2)
        mean = (self.belief.unsqueeze(-1) * types).sum(2).to(theta)
        return torch.where(own, theta.unsqueeze(-1), mean)

    def marginal(self, observer: int, player: int) -> Tensor:
        """What one player believes of another one's type: a probability for each of its candidates, (B, C).

        Raises:
            ValueError: they are the same, or the game has no such player.
        """
        others = [other for other in range(self.game.players) if other != observer]
        if not (0 <= observer < self.game.players and player in others):
            raise ValueError(f"Of {self.game.players} players, {observer} has no belief about {player}.")
        table = self.belief[:, observer].unflatten(
            -1, (-1,) if len(others) == 1 else (self.grid.shape[1],) * len(others)
        )
        return table.movedim(1 + others.index(player), 1).flatten(2).sum(-1) if len(others) > 1 else table

    @property
    def _own(self) -> Tensor:
        """Which entries of types are a player's own, (P, 1, P)."""
        return torch.eye(self.game.players, dtype=torch.bool, device=self.candidates.device).unsqueeze(1)

    def _types(self, theta: Tensor) -> Tensor:
        """Candidates with what each player knows of itself, (B, P, K, P)."""
        return torch.where(self._own, theta[..., None, None], self.candidates.to(theta))

    def _asked_types(self, theta: Tensor) -> Tensor:
        """Types that the policy is asked about, (B, P, R, P): K for predictions, before those that each player acts on.

        For an expectation over what is predicted anyway they are the same.
        """
        true = self._types(theta)
        seen = self._types(self._as_seen(theta)) if self.common else true
        if self.acts == "expectation":
            return torch.cat([seen, true], 2) if self.common else seen
        return torch.cat([seen, self.estimates(theta).unsqueeze(2)], 2)

    def _as_seen(self, theta: Tensor) -> Tensor:
        """What the others take the type of each player to be, on average, (B, P)."""
        others = self.game.players - 1
        return (self.estimates(theta).sum(1) - theta) / others if others else theta

    def _estimated(self, tau: Tensor, x: Tensor, types: Tensor) -> tuple[Tensor, Tensor]:
        """Predictions (B, P, K, P, m), and what all do if each player's estimates are true, (B, P, P, m)."""
        controls = _ask(self.policy.act, types, tau, x).unflatten(0, types.shape[:3])
        return controls[:, :, :-1], controls[:, :, -1]

    def _expected(self, tau: Tensor, x: Tensor, types: Tensor) -> tuple[Tensor, Tensor]:
        """The same, of the costates that are predicted and of their mean."""
        costate = _ask(self.policy.costate, types, tau, x).unflatten(0, types.shape[:3])
        count, respond = self.belief.shape[-1], self.policy.operator.problem.optimal_control
        mean = (self.belief.to(costate)[..., None, None, None] * costate[:, :, -count:]).sum(2, keepdim=True)
        states = x[:, None, None].expand(*types.shape[:2], count, *x.shape[1:])
        return respond(states, costate[:, :, :count]), respond(states[:, :, :1], mean).squeeze(2)


def all_learning(policy: Policy, game: Game, acts: str) -> Believing:
    """Players who all learn, and know that of each other; see `Believing`."""
    return Believing(policy, acts=acts, common=True, game=game)


def _ask(answer: Callable[..., Any], types: Tensor, *parts: Tensor) -> Any:
    """What a function says of the rows of types (B, P, R, P), each with its part (B, ...) of the others, in one row."""
    each = math.prod(types.shape[1:3])
    return answer(*(part.repeat_interleave(each, 0) for part in parts), types.flatten(0, 2))


def _grid(game: Game, types: int | Numbers) -> Tensor:
    """Candidates of every player, (P, C)."""
    box = game.type_box
    if isinstance(types, int):
        if types < 2:
            raise ValueError(f"types must be a number of candidates of at least 2, or the candidates; got {types}.")
        share = torch.linspace(0, 1, types, dtype=box.lo.dtype, device=box.lo.device)
        return box.lo.unsqueeze(-1) + box.width.unsqueeze(-1) * share
    given = tensor_of("types", types).to(box.lo)
    fits = given.shape[:-1] in ((), (game.players,)) and given.dim() and given.shape[-1]
    if not fits or not bool(given.isfinite().all()):
        raise ValueError(f"types must be finite candidates (C,), or ({game.players}, C); got {tuple(given.shape)}.")
    return given.expand(game.players, -1)


def _combinations(grid: Tensor) -> Tensor:
    """All combinations of the others' candidates, (P, C) -> (P, C^(P - 1), P); the own entry is 0."""
    zero = torch.zeros_like(grid[0, :1])
    each = [[zero if j == i else grid[j] for j in range(len(grid))] for i in range(len(grid))]
    return torch.stack([torch.cartesian_prod(*rows).reshape(-1, len(grid)) for rows in each])
