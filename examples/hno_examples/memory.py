"""A policy with memory: every player infers the other's type from how it moves."""

from __future__ import annotations

import torch
from torch import Tensor

from hno.control.policy import Policy
from hno.games import Game


class Believing(Policy):
    """Plays a policy with beliefs in the place of the other player's type; for two players.

    A belief is a distribution over candidate types. It is updated by Bayes' rule: each candidate predicts a control,
    the one that the policy would have chosen for it, and the control that was seen has a normal distribution around it.
    The prediction takes the other player to know the observer's type.

    Args:
        game: the game.
        policy: controls for known types, such as `hno.load_policy(...)`.
        candidates: types that the other player may have, (C,).
        doubt: standard deviation of controls around predictions, in widths of the control box.
    """

    belief: Tensor
    """belief[:, i] is what player i thinks of the other's type, (B, 2, C)."""

    def __init__(self, game: Game, policy: Policy, candidates: Tensor, doubt: float = 0.1) -> None:
        self.game, self.policy, self.candidates, self.doubt = game, policy, candidates, doubt

    def reset(self, x0: Tensor, theta: Tensor) -> None:
        """All candidates are equally likely."""
        self.policy.reset(x0, theta)
        count = len(self.candidates)
        self.belief = torch.full((*theta.shape, count), 1 / count).to(x0)

    def act(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """Each player's part of the policy's answer to its own type and its mean belief, (B, 2, m)."""
        candidates = self.candidates.to(x).expand_as(self.belief)
        answers = self._ask(tau, x, theta, candidates).flip(1)  # from observers to those whom they observe
        self.predicted = torch.stack([answers[:, j, :, j] for j in range(2)], 1)
        own = self._ask(tau, x, theta, (self.belief * candidates).sum(-1, keepdim=True))
        return torch.stack([own[:, i, 0, i] for i in range(2)], 1)

    def observe(self, x: Tensor, u: Tensor, dt: float) -> None:
        """Bayes' rule for the controls that were seen, (B, 2, m)."""
        miss = (u.unsqueeze(2) - self.predicted) / (self.doubt * self.game.control_box.width.to(u)).unsqueeze(-2)
        seen = (-miss.square().sum(-1) / 2).flip(1)  # player i observes the other
        self.belief = (self.belief.log() + seen).softmax(-1)

    def _ask(self, tau: Tensor, x: Tensor, theta: Tensor, other: Tensor) -> Tensor:
        """Controls of both players, if i takes the other's type to be other[:, i, c], (B, 2, C, 2, m)."""
        own = theta.unsqueeze(-1).expand_as(other)
        types = torch.stack([torch.stack([own[:, 0], other[:, 0]], -1), torch.stack([other[:, 1], own[:, 1]], -1)], 1)
        repeats = types[0].numel() // 2
        rows = (part.repeat_interleave(repeats, 0) for part in (tau, x))
        return self.policy.act(*rows, types.flatten(0, 2)).unflatten(0, types.shape[:3])
