"""A policy with memory: the players infer each other's types from how they move.

The shortest one, to show `observe`; `hno.Believing` is for any number of players, forgets, and recovers.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hno.control.policy import Policy
from hno.games import Game


class Believing(Policy):
    """Plays a policy with beliefs in the place of the other player's type; for two players.

    Both see the same motion, so what is believed of a player is known to both. The belief is a distribution over
    candidate types. By Bayes' rule each candidate weighs as much as the control that was seen is likely: the policy
    tells what the candidate would have done, and controls have a normal distribution around that.

    Args:
        game: the game.
        policy: controls for known types, such as `hno.load_policy(...)`.
        candidates: types that a player may have, (C,).
        doubt: standard deviation of controls around predictions, in widths of the control box.
    """

    belief: Tensor
    """belief[:, i] is what is thought of the type of player i, (B, 2, C)."""

    def __init__(self, game: Game, policy: Policy, candidates: Tensor, doubt: float = 0.1) -> None:
        self.game, self.policy, self.candidates, self.doubt = game, policy, candidates, doubt

    def reset(self, x0: Tensor, theta: Tensor) -> None:
        """All candidates are equally likely."""
        self.policy.reset(x0, theta)
        count = len(self.candidates)
        self.belief = torch.full((*theta.shape, count), 1 / count).to(x0)

    def act(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """Each player's answer to its own type and to the mean belief in the other's, (B, 2, m)."""
        candidates = self.candidates.to(x).expand_as(self.belief)
        self.predicted = self._controls(tau, x, candidates, candidates)
        return self._controls(tau, x, theta.unsqueeze(-1), candidates).squeeze(2)

    def observe(self, x: Tensor, u: Tensor, dt: float) -> None:
        """Bayes' rule for the controls that were seen, (B, 2, m)."""
        width = self.doubt * self.game.control_box.width.to(u)
        miss = (u.unsqueeze(2) - self.predicted) / width.unsqueeze(-2)
        self.belief = (self.belief.log() - miss.square().sum(-1) / 2).softmax(-1)

    def _controls(self, tau: Tensor, x: Tensor, own: Tensor, candidates: Tensor) -> Tensor:
        """What player i would do if its type were own[:, i, k], (B, 2, K) -> (B, 2, K, m)."""
        other = (self.belief * candidates).sum(-1, keepdim=True).flip(1).expand_as(own)
        first = torch.stack([own[:, 0], other[:, 0]], -1)
        second = torch.stack([other[:, 1], own[:, 1]], -1)
        types = torch.stack([first, second], 1)  # (B, 2, K, 2)
        times, states = (part.repeat_interleave(own[0].numel(), 0) for part in (tau, x))
        answers = self.policy.act(times, states, types.flatten(0, 2)).unflatten(0, own.shape)
        return answers.diagonal(dim1=1, dim2=3).movedim(-1, 1)  # player i's part of the answer for player i
