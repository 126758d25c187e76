from __future__ import annotations

import pytest
import torch
from hno_examples.source import Coasting

from hno.data import make_sampler
from hno.data.sources import Known
from hno.games import make
from hno.registry import UnknownNameError
from hno.types import Points
from tests.examples.conftest import Train

pytestmark = pytest.mark.usefixtures("installed")


def draw(source: Coasting, window: float = 1.0) -> Points:
    theta = torch.ones(200, 2)
    return source.draw(make("tracking"), theta, window, Known(None, None), torch.Generator().manual_seed(0))


@pytest.mark.parametrize("window", [0.1, 1.0])
def test_points_lie_where_straight_motion_from_the_start_box_leads(window: float):
    game, points = make("tracking"), draw(Coasting(spread=0.0), window)
    assert (points.tau <= window * game.horizon).all()
    back = points.x[..., 0] - game.speed * (game.horizon - points.tau)[:, None]
    start = torch.stack([back, points.x[..., 1]], -1)
    assert game.initial_box.widened(1.001).contains(start).all()


def test_the_option_spreads_them():
    narrow, wide = draw(Coasting(spread=0.0)), draw(Coasting(spread=0.1))
    moved = (wide.x - narrow.x)[..., 1].std() / make("tracking").state_box.width[0, 1]
    assert 0.08 < moved < 0.12


def test_options_are_checked():
    with pytest.raises(UnknownNameError, match="Did you mean 'spread'"):
        make_sampler({"coasting": {"share": 1.0, "spraed": 0.1}})
    with pytest.raises(ValueError, match="spread must be a finite number"):
        make_sampler({"coasting": {"share": 1.0, "spread": -0.1}})


def test_trains_on_its_points(train: Train):
    terms = {"value": {}, "costate": {}, "residual": {}}
    sampler = {"coasting": {"share": 1.0, "spread": 0.0}}
    game = make("tracking")
    trained = train(game, [(1, 1)], terms=terms, weights={"value": 1, "costate": 1, "residual": 0.02}, sampler=sampler)
    assert trained.after < 0.5 * trained.before
    points = trained.data.batch(3)["interior"].points
    assert (points.x[..., 1].abs() <= 0.5).all()  # the start box is that narrow, the PDE box is not
