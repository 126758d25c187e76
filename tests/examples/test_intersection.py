"""The intersection is in the tree; here it is trained as any game from outside is."""

from __future__ import annotations

import pytest
import torch

from hno.games import make
from tests.examples.conftest import Train


@pytest.mark.slow
def test_trains_to_values_in_which_types_of_each_player_matter(train: Train):
    game = make("intersection")
    trained = train(game, [(1, 1), (1, 5), (5, 1)], steps=400)
    assert trained.after < 0.5 * trained.before
    x = game.initial_box.sample(16, torch.Generator().manual_seed(0))
    tau, theta = torch.full((16,), game.horizon), torch.tensor([[1.0, 5.0]]).expand(16, 2)
    with torch.no_grad():
        one, swapped, other = (
            trained.operator.value(tau, states, types)
            for states, types in ((x, theta), (x.flip(1), theta.flip(1)), (x, theta.flip(1)))
        )
    torch.testing.assert_close(swapped, one.flip(1), atol=1e-4, rtol=1e-4)  # the players are interchangeable,
    assert (other - one).abs().median() > 1e-3 * one.abs().median()  # but who claims how much is not
