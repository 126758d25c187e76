from __future__ import annotations

import torch
from hno_examples.memory import Believing
from hno_examples.tracking import Tracking
from torch import Tensor

import hno
from hno.control import Feedback, as_policy
from tests.examples.conftest import Train

CANDIDATES = torch.tensor([1.0, 3.0, 5.0])


class Recorded(Believing):
    """Beliefs after every step."""

    def reset(self, x0: Tensor, theta: Tensor) -> None:
        super().reset(x0, theta)
        self.past = [self.belief]

    def observe(self, x: Tensor, u: Tensor, dt: float) -> None:
        super().observe(x, u, dt)
        self.past.append(self.belief)


def test_bayes_rule_on_controls_that_reveal_the_type():
    """Controls of 0.2, 0.6 and 1 for the three candidates: beliefs are the normal distribution's weights."""
    policy = Believing(Tracking(), as_policy(lambda tau, x, theta: theta.unsqueeze(-1) / 5), CANDIDATES, doubt=0.1)
    x, theta = torch.zeros(1, 2, 2), torch.tensor([[1.0, 5.0]])
    policy.reset(x, theta)
    u = policy.act(torch.ones(1), x, theta)
    torch.testing.assert_close(u, theta.unsqueeze(-1) / 5)
    policy.observe(x, u, 0.1)
    miss = (CANDIDATES - theta[0].unsqueeze(1)) / 5 / (0.1 * 6)
    torch.testing.assert_close(policy.belief[0], (-miss.square() / 2).softmax(-1))
    policy.reset(x, theta)
    torch.testing.assert_close(policy.belief, torch.full((1, 2, 3), 1 / 3))


def test_each_player_answers_to_its_own_type_and_to_the_belief_in_the_other():
    """Controls theta_i - 2 theta_j; the mean belief is 3."""
    policy = Believing(Tracking(), as_policy(lambda tau, x, theta: (theta - 2 * theta.flip(-1))[..., None]), CANDIDATES)
    x, theta = torch.zeros(2, 2, 2), torch.tensor([[1.0, 5.0], [2.0, 4.0]])
    policy.reset(x, theta)
    torch.testing.assert_close(policy.act(torch.ones(2), x, theta).squeeze(-1), theta - 6)


def test_the_belief_moves_to_the_true_type(train: Train):
    """A player does exactly what its own type predicts, so nothing that is seen speaks against it."""
    game = Tracking()
    trained = train(game, [(1, 1), (1, 5), (5, 1), (5, 5)])
    policy = Recorded(game, Feedback(trained.operator), torch.tensor([1.0, 5.0]), doubt=0.05)
    truth = torch.tensor([[0, 0], [0, 1], [1, 0], [1, 1]]).repeat(8, 1)
    x0 = game.initial_box.sample(len(truth), torch.Generator().manual_seed(3))
    played = hno.rollout(game, policy, x0, 1.0 + 4 * truth, dt=0.1)
    assert played.x.isfinite().all()
    right = torch.stack(policy.past).gather(-1, truth[None, :, :, None].expand(len(policy.past), -1, -1, 1))
    assert (right.diff(dim=0) > -1e-5).all()
    assert (right[0] == 0.5).all()
    assert right[-1].median() > 0.8
