from __future__ import annotations

from pathlib import Path

import pytest
import torch
from hno_examples.physics_only import train
from hno_examples.tracking import Tracking

from hno.data import datamodule
from hno.losses import hji_residual
from hno.operators import make_operator
from hno.types import Points


def test_it_solves_the_equation_without_a_label(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
):
    """Riders who have passed each other are worth -sqrt(stiffness) across^2, see `Tracking`."""

    def never(*arguments: object) -> None:
        raise AssertionError("labels were asked for")

    monkeypatch.setattr(datamodule, "labels_for", never)
    torch.manual_seed(0)
    game = Tracking()
    x = game.state_box.sample(200, torch.Generator().manual_seed(1))
    points = Points(game.horizon * torch.rand(200), x, torch.ones(200, 2))
    before = hji_residual(game, points, make_operator(game).field(points))
    operator, fitted = train(game, tmp_path, steps=100, rows=128)
    assert not [found for found in recwarn if "list" in str(found.message)], "no held-out rows are no reason to warn"
    after = hji_residual(game, points, operator.field(points))
    assert after.abs().median() < 0.5 * before.abs().median()
    assert fitted.best is None
    assert (tmp_path / "last.ckpt").exists()
    end = points._replace(tau=torch.zeros(200))
    torch.testing.assert_close(operator.field(end).value, game.terminal_value(x))
