"""Collocation points alone: nothing is solved where nothing reads labels."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest
import torch

from hno.data import Collocation, GameData, LabelPlan, make_sampler
from hno.data import datamodule as module
from hno.games import make

GAMES = ("narrow_road", "lane_change", "drone")
TYPES = [(1.0, 1.0), (1.0, 5.0)]


@pytest.fixture
def unsolved(monkeypatch: pytest.MonkeyPatch) -> None:
    """A solver that must not be asked."""

    def fail(*arguments: object) -> None:
        raise AssertionError("labels were solved")

    monkeypatch.setattr(module, "labels_for", fail)


def points_only(
    sampler: Mapping[str, float],
    streams: tuple[str, ...] = ("interior",),
    game: str = "narrow_road",
    sizes: Mapping[str, int | None] = {"bvp": 4, "interior": 50, "terminal": 4},
) -> GameData:
    plan = LabelPlan(types=TYPES, cache=Path("unused"))
    return GameData(make(game), streams, 0, plan, Collocation(make_sampler(sampler)), sizes)


@pytest.mark.parametrize("sampler", [{"box": 1.0}, {"box": 0.3, "band": 0.7}, {"rollout": 1.0}])
@pytest.mark.parametrize("streams", [("interior",), ("interior", "terminal")])
def test_no_label_is_solved_where_no_source_reads_labels(
    unsolved: None, sampler: Mapping[str, float], streams: tuple[str, ...]
) -> None:
    data = points_only(sampler, streams)
    assert not data.needs_labels
    data.setup("fit")
    batch = data.batch(3)
    assert set(batch) == set(streams)
    assert bool(data.game.state_box.contains(batch["interior"].points.x).all())
    assert {tuple(theta) for theta in batch["interior"].points.theta.tolist()} == set(TYPES)
    assert data.large_batch(3).keys() == batch.keys()
    assert list(data.val_dataloader()) == [None]
    assert data.held_out() == []


@pytest.mark.parametrize(
    ("sampler", "streams"),
    [({"box": 1.0}, ("bvp", "interior")), ({"box": 0.9, "labels": 0.1}, ("interior",)), ({"labels": 1}, ("terminal",))],
)
def test_labels_are_solved_where_something_reads_them(
    unsolved: None, sampler: Mapping[str, float], streams: tuple[str, ...]
) -> None:
    data = points_only(sampler, streams)
    assert data.needs_labels
    with pytest.raises(AssertionError, match="labels were solved"):
        data.setup("fit")


def test_a_source_that_no_stream_draws_from_needs_nothing(unsolved: None) -> None:
    assert not points_only({"labels": 0.0, "box": 1.0}).needs_labels


@pytest.mark.parametrize("game", GAMES)
def test_scales_are_positive_and_those_of_terminal_values(unsolved: None, game: str) -> None:
    data = points_only({"box": 1.0}, game=game)
    data.setup("fit")
    value, costate = data.scales()
    assert costate.shape == (2, 2, data.game.state_dim)
    assert bool((costate > 0).all() & costate.isfinite().all())
    x = data.game.state_box.sample(20_000, torch.Generator().manual_seed(9))
    assert float(value) == pytest.approx(float(data.game.terminal_value(x).abs().mean()), rel=0.1)
    torch.testing.assert_close(costate, (value / data.game.state_box.width).expand(2, -1, -1))


def test_all_rows_need_labels_to_count(unsolved: None) -> None:
    with pytest.raises(ValueError, match=r"Without labels, data\.batch_sizes\.interior must be a number"):
        points_only({"box": 1.0}, sizes={"bvp": 4, "interior": None, "terminal": 4})


def test_a_source_without_labels_says_so(unsolved: None) -> None:
    game, theta = make("narrow_road"), torch.ones(3, 2)
    (share,) = make_sampler({"labels": 1.0}).values()
    with pytest.raises(ValueError, match="nothing is labelled"):
        share.source.draw(game, theta, 1.0, module.Known(None, None), torch.Generator())
