"""Equilibria from chosen states, kept like labels."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from hno.data import states
from hno.data.states import equilibria_from
from hno.games import make
from hno.types import Extremal, Status
from tests.fakes import fake_labels

THETA = torch.tensor([[1.0, 1.0]]).double()


def test_what_is_left_of_a_game_is_a_game_of_that_horizon(tmp_path: Path) -> None:
    game = make("narrow_road")
    x0 = ((game.initial_box.lo + game.initial_box.hi) / 2).double().unsqueeze(0)
    found = equilibria_from(game, x0, THETA, 0.3, tmp_path, workers=1)
    assert found.status.tolist() == [Status.CONVERGED]
    torch.testing.assert_close(found.t[-1], torch.tensor(0.3).double())
    torch.testing.assert_close(found.x[:, 0], x0)
    assert game.horizon == 3


def test_states_are_solved_once_for_each_game_type_and_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    solved = []

    def solve(game, x0, theta, settings, workers, report) -> Extremal:
        solved.append(game.horizon)
        return fake_labels(game, theta[0].tolist(), len(x0), start=x0)

    monkeypatch.setattr(states, "solve_many", solve)
    game = make("narrow_road")
    x0 = game.initial_box.sample(2, torch.Generator().manual_seed(0)).double()
    both = THETA.expand(2, -1)
    first = equilibria_from(game, x0, both, 1.0, tmp_path)
    again = equilibria_from(game, x0, both, 1.0, tmp_path)
    torch.testing.assert_close(first.value, again.value)
    assert solved == [1.0]
    for other in ((game, x0 + 0.1, both, 1.0), (game, x0, 2 * both, 1.0), (game, x0, both, 2.0)):
        equilibria_from(*other, tmp_path)
    equilibria_from(make("narrow_road", radius=1.5), x0, both, 1.0, tmp_path)
    assert len(solved) == 5
    for file in tmp_path.rglob("*.safetensors"):
        file.write_bytes(b"damaged")
    equilibria_from(game, x0, both, 1.0, tmp_path)
    assert len(solved) == 6
