from __future__ import annotations

import pytest
import torch
from hno_examples.memory import Believing
from hno_examples.tracking import Tracking

import hno
from hno.control.policy import Feedback, FunctionPolicy
from tests.examples.conftest import Train

CANDIDATES = torch.tensor([1.0, 3.0, 5.0])


def test_bayes_rule_on_controls_that_reveal_the_type():
    """One observation at controls 0.2, 0.6 and 1 for the three candidates gives the normal distribution's weights."""
    game = Tracking()
    policy = Believing(game, FunctionPolicy(lambda tau, x, theta: theta.unsqueeze(-1) / 5), CANDIDATES, doubt=0.1)
    x, theta = torch.zeros(1, 2, 2), torch.tensor([[1.0, 5.0]])
    policy.reset(x, theta)
    u = policy.act(torch.ones(1), x, theta)
    torch.testing.assert_close(u, theta.unsqueeze(-1) / 5)
    policy.observe(x, u, 0.1)
    miss = (CANDIDATES.unsqueeze(0) - torch.tensor([5.0, 1.0]).unsqueeze(1)) / 5 / (0.1 * 6)
    torch.testing.assert_close(policy.belief[0], (-miss.square() / 2).softmax(-1))
    policy.reset(x, theta)
    assert (policy.belief == 1 / 3).all()


@pytest.mark.parametrize("truth", [(1.0, 5.0), (5.0, 1.0), (5.0, 5.0), (1.0, 1.0)])
def test_the_belief_moves_to_the_true_type(train: Train, truth: tuple[float, float]):
    game = Tracking()
    trained = train(game, [(1, 1), (1, 5), (5, 1), (5, 5)], trajectories=8, steps=300)
    policy = Believing(game, Feedback(trained.operator), torch.tensor([1.0, 5.0]), doubt=0.05)
    x0 = game.initial_box.sample(16, torch.Generator().manual_seed(3))
    played = hno.rollout(game, policy, x0, torch.tensor([truth]).expand(16, 2), dt=0.1)
    assert played.x.isfinite().all()
    right = torch.stack([policy.belief[:, i, int(truth[1 - i] == 5)] for i in range(2)], 1)
    assert right.median() > 0.6, right
